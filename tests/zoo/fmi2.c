/* The models as FMUs of FMI 2.0. */

#include "zoo.h"

typedef struct {
    Logger logger;
    void *allocate, *release, *finished, *environment;
} Callbacks;

void *fmi2Instantiate(const char *name, int type, const char *token, const char *location,
                      const Callbacks *callbacks, int visible, int logging) {
    return zoo_instantiate(&(Birth){name, token, location, callbacks->logger,
                                    callbacks->environment, logging});
}

void fmi2FreeInstance(Animal *me) {
    zoo_free(me);
}

int fmi2SetDebugLogging(Animal *me, int on, size_t count, const char *const *categories) {
    return zoo_listen(me, on, count, categories);
}

int fmi2SetupExperiment(Animal *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    return zoo_call(me, SETUP);
}

int fmi2EnterInitializationMode(Animal *me) {
    return zoo_call(me, ENTER);
}

int fmi2ExitInitializationMode(Animal *me) {
    return zoo_exit(me);
}

int fmi2Terminate(Animal *me) {
    return zoo_call(me, TERMINATE);
}

int fmi2Reset(Animal *me) {
    return zoo_reset(me);
}

int fmi2DoStep(Animal *me, double time, double step_size, int no_set_state) {
    return zoo_step(me, step_size, no_set_state);
}

int fmi2GetBooleanStatus(Animal *me, int kind, int *value) {
    *value = zoo_stops(me);
    return OK;
}

int fmi2GetReal(Animal *me, const unsigned *references, size_t count, double *values) {
    return zoo_get(me, references, count, values);
}

int fmi2SetReal(Animal *me, const unsigned *references, size_t count, const double *values) {
    return zoo_set(me, references, count, values);
}

int fmi2GetFMUstate(Animal *me, void **state) {
    return zoo_get_state(me, state);
}

int fmi2SetFMUstate(Animal *me, void *state) {
    return zoo_set_state(me, state);
}

int fmi2FreeFMUstate(Animal *me, void **state) {
    return zoo_free_state(state);
}

int fmi2SerializedFMUstateSize(Animal *me, void *state, size_t *size) {
    return zoo_size_of_bytes(me, state, size);
}

int fmi2SerializeFMUstate(Animal *me, void *state, char *bytes, size_t size) {
    return zoo_to_bytes(me, state, bytes, size);
}

int fmi2DeSerializeFMUstate(Animal *me, const char *bytes, size_t size, void **state) {
    return zoo_from_bytes(me, bytes, size, state);
}

const char *fmi2GetVersion(void) {
    return "2.0";
}

const char *fmi2GetTypesPlatform(void) {
    return "default";
}

#include STUBS
