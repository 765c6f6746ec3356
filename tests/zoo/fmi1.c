/* The models as FMUs of FMI 1.0. */

#include "zoo.h"

typedef struct {
    Logger logger;
    void *allocate, *release, *finished;
} Callbacks;

void *Zoo_fmiInstantiateSlave(const char *name, const char *token, const char *location,
                              const char *type, double timeout, char visible, char interactive,
                              Callbacks callbacks, char logging) {
    return zoo_instantiate(&(Birth){name, token, location, callbacks.logger, NULL, logging});
}

void Zoo_fmiFreeSlaveInstance(Animal *me) {
    zoo_free(me);
}

int Zoo_fmiSetDebugLogging(Animal *me, char on) {
    return zoo_listen(me, on, 0, NULL);
}

int Zoo_fmiInitializeSlave(Animal *me, double start, char stop_defined, double stop) {
    return zoo_initialize(me);
}

int Zoo_fmiTerminateSlave(Animal *me) {
    return zoo_call(me, TERMINATE);
}

int Zoo_fmiResetSlave(Animal *me) {
    return zoo_reset(me);
}

int Zoo_fmiDoStep(Animal *me, double time, double step_size, char new_step) {
    return zoo_step(me, step_size, false);
}

int Zoo_fmiGetReal(Animal *me, const unsigned *references, size_t count, double *values) {
    return zoo_get(me, references, count, values);
}

int Zoo_fmiSetReal(Animal *me, const unsigned *references, size_t count, const double *values) {
    return zoo_set(me, references, count, values);
}

const char *Zoo_fmiGetVersion(void) {
    return "1.0";
}

const char *Zoo_fmiGetTypesPlatform(void) {
    return "standard32";
}

#include STUBS
