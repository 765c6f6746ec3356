/* The models as FMUs of FMI 3.0. */

#include "zoo.h"

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                  bool visible, bool logging, bool event_mode, bool early_return,
                                  const unsigned *intermediate, size_t intermediate_count,
                                  void *environment, Logger logger, void *intermediate_update) {
    return zoo_instantiate(&(Birth){name, token, resources, logger, environment, logging});
}

void fmi3FreeInstance(Animal *me) {
    zoo_free(me);
}

int fmi3SetDebugLogging(Animal *me, bool on, size_t count, const char *const *categories) {
    return zoo_listen(me, on, count, categories);
}

int fmi3EnterInitializationMode(Animal *me, bool tolerance_defined, double tolerance, double start,
                                bool stop_defined, double stop) {
    return zoo_enter(me);
}

int fmi3ExitInitializationMode(Animal *me) {
    return zoo_exit(me);
}

int fmi3Terminate(Animal *me) {
    return zoo_call(me, TERMINATE);
}

int fmi3Reset(Animal *me) {
    return zoo_reset(me);
}

int fmi3DoStep(Animal *me, double time, double step_size, bool no_set_state, bool *events,
               bool *stop, bool *early, double *last) {
    const int status = zoo_step(me, step_size, no_set_state);

    *events = *early = false;
    *stop = zoo_stops(me);
    *last = time + step_size;
    return status;
}

int fmi3GetFloat64(Animal *me, const unsigned *references, size_t count, double *values,
                   size_t values_count) {
    return zoo_get(me, references, count, values);
}

int fmi3SetFloat64(Animal *me, const unsigned *references, size_t count, const double *values,
                   size_t values_count) {
    return zoo_set(me, references, count, values);
}

int fmi3GetFMUState(Animal *me, void **state) {
    return zoo_get_state(me, state);
}

int fmi3SetFMUState(Animal *me, void *state) {
    return zoo_set_state(me, state);
}

int fmi3FreeFMUState(Animal *me, void **state) {
    return zoo_free_state(state);
}

const char *fmi3GetVersion(void) {
    return "3.0";
}

#include STUBS
