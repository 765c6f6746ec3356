/* An FMU of FMI 2.0 whose instances begin anew at first, and later no more: what tires is in its
   token, as words in any order.

   "reset", "restore", "instance": after LIMIT calls, or with later instances, an error shows in the
   first step.
   "stubborn": a reset does nothing from the start.
   "noise": every step adds a random number if the environment variable TIRES_NOISE is set.
   "crash": the process ends if the first step of all instances has an input of 1.
   "fails": instead of another value, the step returns Error.
   y' = gain u. Reals: 0 "u" (input), 1 "y" (output), 2 "gain" (parameter). */

#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "fmi2_stubs.h"

enum { LIMIT = 60, U = 0, Y, GAIN, VALUES };

typedef struct {
    double values[VALUES];
    double keep; /* added in the first step after something tired */
    int resets, restores;
    char token[60];
} Model;

static int instances, has_stepped;

static int is(const Model *me, const char *word) {
    return strstr(me->token, word) != NULL;
}

static void set_start(Model *me) {
    memset(me->values, 0, sizeof me->values);
    me->values[GAIN] = 1.0;
}

void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                      const void *callbacks, int visible, int logging) {
    Model *me = calloc(1, sizeof *me);
    strncpy(me->token, token, sizeof me->token - 1);
    set_start(me);
    instances++;
    me->keep = is(me, "instance") && instances > LIMIT ? 0.5 : 0.0;
    return me;
}

void fmi2FreeInstance(Model *me) {
    free(me);
}

int fmi2SetupExperiment(Model *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    return 0;
}

int fmi2EnterInitializationMode(Model *me) {
    return 0;
}

int fmi2ExitInitializationMode(Model *me) {
    return 0;
}

int fmi2DoStep(Model *me, double time, double step_size, int no_set_state) {
    double *v = me->values;

    if (is(me, "crash") && !has_stepped && v[U] == 1.0) {
        raise(SIGSEGV);
    }
    has_stepped = 1;
    if (is(me, "noise")) {
        struct timespec now;
        clock_gettime(CLOCK_MONOTONIC, &now);
        v[Y] += 1e-9 * (double)(now.tv_nsec % 1000) * (getenv("TIRES_NOISE") != NULL);
    } else if (me->keep > 0.0 && is(me, "fails")) {
        return 3;
    }
    v[Y] += step_size * v[GAIN] * v[U] + me->keep;
    me->keep = 0.0;
    return 0;
}

int fmi2GetReal(Model *me, const unsigned *vr, size_t count, double *values) {
    for (size_t i = 0; i < count; i++) {
        values[i] = me->values[vr[i]];
    }
    return 0;
}

int fmi2SetReal(Model *me, const unsigned *vr, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        me->values[vr[i]] = values[i];
    }
    return 0;
}

int fmi2Terminate(Model *me) {
    return 0;
}

int fmi2Reset(Model *me) {
    if (is(me, "stubborn")) {
        return 0;
    }
    set_start(me);
    me->keep = is(me, "reset") && ++me->resets > LIMIT ? 0.5 : 0.0;
    return 0;
}

int fmi2GetFMUstate(Model *me, void **state) {
    if (*state == NULL) {
        *state = malloc(sizeof *me);
    }
    memcpy(*state, me, sizeof *me);
    return 0;
}

int fmi2SetFMUstate(Model *me, void *state) {
    const Model before = *me;

    memcpy(me, state, sizeof *me);
    me->restores = before.restores + 1;
    me->keep = is(me, "restore") && me->restores > LIMIT ? 0.5 : 0.0;
    return 0;
}

int fmi2FreeFMUstate(Model *me, void **state) {
    free(*state);
    *state = NULL;
    return 0;
}
