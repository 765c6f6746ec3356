/* The models as FMUs of FMI 3.0, with both interfaces. */

#include "exchange.h"

#include <stdlib.h>

void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources,
                                   bool visible, bool logging, void *environment, void *logger) {
    return core_new(name, true, logger, environment);
}

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                  bool visible, bool logging, bool event_mode, bool early_return,
                                  const unsigned *intermediate, size_t intermediate_count,
                                  void *environment, void *logger, void *intermediate_update) {
    return core_new(name, false, logger, environment);
}

void fmi3FreeInstance(Model *me) {
    free(me);
}

int fmi3EnterInitializationMode(Model *me, bool has_tolerance, double tolerance, double start,
                                bool has_stop, double stop) {
    return core_enter_initialization(me, start);
}

int fmi3ExitInitializationMode(Model *me) {
    return core_exit_initialization(me);
}

int fmi3Terminate(Model *me) {
    me->mode = TERMINATED;
    return OK;
}

int fmi3Reset(Model *me) {
    return core_reset(me);
}

int fmi3GetFloat64(Model *me, const unsigned *references, size_t count, double *values,
                   size_t number_of_values) {
    return core_get(me, references, count, values);
}

int fmi3SetFloat64(Model *me, const unsigned *references, size_t count, const double *values,
                   size_t number_of_values) {
    return core_set(me, references, count, values);
}

int fmi3DoStep(Model *me, double time, double step, bool no_set_state, bool *event,
               bool *terminate, bool *early, double *last) {
    const int status = core_do_step(me, time, step);

    *event = false;
    *early = !me->stops && me->time < time + step - 1e-9;
    *terminate = me->stops;
    *last = me->time;
    return status == DISCARD && me->stops ? OK : status;
}

int fmi3EnterEventMode(Model *me) {
    return core_enter_events(me);
}

int fmi3UpdateDiscreteStates(Model *me, bool *again, bool *terminate, bool *nominals_changed,
                             bool *states_changed, bool *has_next, double *next) {
    const int status = core_update(me);

    *again = me->again;
    *terminate = me->stops;
    *nominals_changed = false;
    *states_changed = true;
    *has_next = me->next_event < INFINITY;
    *next = me->next_event;
    return status;
}

int fmi3EnterContinuousTimeMode(Model *me) {
    return core_enter_continuous(me);
}

int fmi3CompletedIntegratorStep(Model *me, bool no_set_state, bool *event, bool *terminate) {
    const int status = core_complete(me);

    *event = me->wants_event;
    *terminate = me->stops;
    return status;
}

int fmi3SetTime(Model *me, double time) {
    return core_set_time(me, time);
}

int fmi3SetContinuousStates(Model *me, const double *x, size_t count) {
    return core_set_states(me, x, count);
}

int fmi3GetContinuousStates(Model *me, double *x, size_t count) {
    return core_get_states(me, x, count);
}

int fmi3GetContinuousStateDerivatives(Model *me, double *rates, size_t count) {
    return core_rates(me, rates, count);
}

int fmi3GetEventIndicators(Model *me, double *z, size_t count) {
    return core_indicators(me, z, count);
}

int fmi3GetNominalsOfContinuousStates(Model *me, double *x, size_t count) {
    return core_nominals(me, x, count);
}

int fmi3GetDirectionalDerivative(Model *me, const unsigned *unknowns, size_t count,
                                 const unsigned *knowns, size_t number_of_knowns,
                                 const double *seed, size_t number_of_seeds, double *result,
                                 size_t number_of_results) {
    return core_differentiate(me, unknowns, count, knowns, number_of_knowns, seed, result);
}

int fmi3GetAdjointDerivative(Model *me, const unsigned *unknowns, size_t count,
                             const unsigned *knowns, size_t number_of_knowns, const double *seed,
                             size_t number_of_seeds, double *result, size_t number_of_results) {
    for (size_t j = 0; j < number_of_knowns; j++) {
        result[j] = 0.0;
        for (size_t i = 0; i < count; i++) {
            result[j] += seed[i] * model_partial(me, unknowns[i], knowns[j]);
        }
    }
    return number_of_seeds == count && number_of_results == number_of_knowns ? OK : ERROR;
}

int fmi3GetFMUState(Model *me, void **state) {
    return core_get_state(me, state);
}

int fmi3SetFMUState(Model *me, const void *state) {
    return core_set_state(me, state);
}

int fmi3FreeFMUState(Model *me, void **state) {
    return core_free_state(state);
}

int fmi3SerializedFMUStateSize(Model *me, void *state, size_t *size) {
    *size = sizeof *me;
    return OK;
}

int fmi3SerializeFMUState(Model *me, void *state, char *bytes, size_t size) {
    return core_to_bytes(state, bytes, size);
}

int fmi3DeserializeFMUState(Model *me, const char *bytes, size_t size, void **state) {
    return core_from_bytes(bytes, size, state);
}

const char *fmi3GetVersion(void) {
    return "3.0";
}

#define STUB(name)                                                                                 \
    int name(void) {                                                                               \
        return ERROR;                                                                              \
    }
#include STUBS
