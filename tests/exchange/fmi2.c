/* The models as FMUs of FMI 2.0, with both interfaces. */

#include "exchange.h"

#include <stdlib.h>

typedef struct {
    void *logger, *allocate, *release, *finished, *environment;
} Callbacks;

typedef struct {
    int again, terminate, nominals_changed, states_changed, has_next;
    double next;
} EventInfo;

void *fmi2Instantiate(const char *name, int type, const char *token, const char *location,
                      const Callbacks *callbacks, int visible, int logging) {
    return core_new(name, type == 0, callbacks->logger, callbacks->environment);
}

void fmi2FreeInstance(Model *me) {
    free(me);
}

int fmi2SetupExperiment(Model *me, int has_tolerance, double tolerance, double start, int has_stop,
                        double stop) {
    me->time = start;
    return me->mode == INSTANTIATED ? OK : ERROR;
}

int fmi2EnterInitializationMode(Model *me) {
    return core_enter_initialization(me, me->time);
}

int fmi2ExitInitializationMode(Model *me) {
    return core_exit_initialization(me);
}

int fmi2Terminate(Model *me) {
    me->mode = TERMINATED;
    return OK;
}

int fmi2Reset(Model *me) {
    return core_reset(me);
}

int fmi2GetReal(Model *me, const unsigned *references, size_t count, double *values) {
    return core_get(me, references, count, values);
}

int fmi2SetReal(Model *me, const unsigned *references, size_t count, const double *values) {
    return core_set(me, references, count, values);
}

int fmi2DoStep(Model *me, double time, double step, int no_set_state) {
    const int status = core_do_step(me, time, step);

    return status == OK && me->time < time + step - 1e-9 ? DISCARD : status;
}

int fmi2GetRealStatus(Model *me, int kind, double *value) {
    *value = me->time;
    return kind == 2 ? OK : DISCARD;
}

int fmi2GetBooleanStatus(Model *me, int kind, int *value) {
    *value = me->stops;
    return OK;
}

int fmi2EnterEventMode(Model *me) {
    return core_enter_events(me);
}

int fmi2NewDiscreteStates(Model *me, EventInfo *info) {
    const int status = core_update(me);

    *info = (EventInfo){.again = me->again,
                        .terminate = me->stops,
                        .states_changed = 1,
                        .has_next = me->next_event < INFINITY,
                        .next = me->next_event};
    return status;
}

int fmi2EnterContinuousTimeMode(Model *me) {
    return core_enter_continuous(me);
}

int fmi2CompletedIntegratorStep(Model *me, int no_set_state, int *event, int *terminate) {
    const int status = core_complete(me);

    *event = me->wants_event;
    *terminate = me->stops;
    return status;
}

int fmi2SetTime(Model *me, double time) {
    return core_set_time(me, time);
}

int fmi2SetContinuousStates(Model *me, const double *x, size_t count) {
    return core_set_states(me, x, count);
}

int fmi2GetContinuousStates(Model *me, double *x, size_t count) {
    return core_get_states(me, x, count);
}

int fmi2GetDerivatives(Model *me, double *rates, size_t count) {
    return core_rates(me, rates, count);
}

int fmi2GetEventIndicators(Model *me, double *z, size_t count) {
    return core_indicators(me, z, count);
}

int fmi2GetNominalsOfContinuousStates(Model *me, double *x, size_t count) {
    return core_nominals(me, x, count);
}

int fmi2GetDirectionalDerivative(Model *me, const unsigned *unknowns, size_t count,
                                 const unsigned *knowns, size_t number_of_knowns,
                                 const double *seed, double *result) {
    return core_differentiate(me, unknowns, count, knowns, number_of_knowns, seed, result);
}

int fmi2GetFMUstate(Model *me, void **state) {
    return core_get_state(me, state);
}

int fmi2SetFMUstate(Model *me, const void *state) {
    return core_set_state(me, state);
}

int fmi2FreeFMUstate(Model *me, void **state) {
    return core_free_state(state);
}

int fmi2SerializedFMUstateSize(Model *me, void *state, size_t *size) {
    *size = sizeof *me;
    return OK;
}

int fmi2SerializeFMUstate(Model *me, void *state, char *bytes, size_t size) {
    return core_to_bytes(state, bytes, size);
}

int fmi2DeSerializeFMUstate(Model *me, const char *bytes, size_t size, void **state) {
    return core_from_bytes(bytes, size, state);
}

const char *fmi2GetVersion(void) {
    return "2.0";
}

const char *fmi2GetTypesPlatform(void) {
    return "default";
}

#define STUB(name)                                                                                 \
    int name(void) {                                                                               \
        return ERROR;                                                                              \
    }
#include STUBS
