/* A useful FMU of FMI 2.0 that does not keep a promise: which one is in its token.

   x' = gain u - x / tau, y = x, by explicit Euler with internal steps of 1 ms.
   Reals: 0 "u" (input), 1 "y" (output), 2 "gain" and 3 "tau" (parameters), 4 "clock" (output: what
   the FMU itself takes for the time since the start), 5 "calls" (output), 6 "returns" (output:
   whether states of earlier times may be restored, as the last step was told). */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define OWN_BOOLEAN_STATUS
#include "fmi2_stubs.h"

enum { U, Y, GAIN, TAU, CLOCK, CALLS, RETURNS, VALUES };

typedef struct {
    void *logger;
} Callbacks;

typedef struct {
    double values[VALUES];
    double stop_after; /* asks to stop after so many seconds, if positive */
    int stopped;
    int resets;
    int open; /* a block of memory of its own */
    char token[40];
    double *history;
} Model;

static double shared_state;
static int made, in_use;
static char *cursor; /* of strtok, as old readers of tables use it */

static int is(const Model *me, const char *token) {
    return strcmp(me->token, token) == 0;
}

static void set_start(Model *me) {
    memset(me->values, 0, sizeof me->values);
    me->values[GAIN] = 1.0;
    me->values[TAU] = 0.5;
    me->stopped = 0;
}

void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                      const Callbacks *callbacks, int visible, int logging) {
    if (strcmp(token, "one in a process") == 0 && made > 0) {
        return NULL;
    }
    Model *me = calloc(1, sizeof *me);
    snprintf(me->token, sizeof me->token, "%s", token);
    set_start(me);
    me->history = calloc(8, sizeof *me->history);
    me->stop_after = strncmp(token, "stops", 5) == 0 ? 0.35 : 0.0;
    made++;
    in_use++;
    return me;
}

void fmi2FreeInstance(Model *me) {
    in_use--;
    free(me->history);
    free(me);
}

int fmi2SetupExperiment(Model *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    return 0;
}

int fmi2EnterInitializationMode(Model *me) {
    return 0;
}

/* Reads a table as JModelica's weather models do: not safe in threads. */
static int read_table(void) {
    int rows = 0;
    char table[400] = "";

    for (int i = 0; i < 40; i++) {
        strcat(table, "12 34;");
    }
    for (char *row = strtok(table, ";"); row != NULL; row = strtok(NULL, ";")) {
        rows++;
        usleep(20);
    }
    cursor = table;
    return rows == 40 ? 0 : 3;
}

int fmi2ExitInitializationMode(Model *me) {
    if (is(me, "strtok")) {
        return read_table();
    }
    if (is(me, "globals")) {
        shared_state = 0.0;
    }
    return 0;
}

static void advance(Model *me, double step_size) {
    double *v = me->values;
    const int steps = (int)(step_size * 1000.0 + 0.5);

    for (int i = 0; i < steps; i++) {
        double *x = is(me, "globals") ? &shared_state : &v[Y];
        *x += 0.001 * (v[GAIN] * v[U] - *x / v[TAU]);
    }
    if (is(me, "globals")) {
        v[Y] = shared_state;
    }
    if (is(me, "library keeps") || is(me, "noise")) {
        shared_state += 0.001;
        v[Y] += is(me, "noise") ? 1e-9 * (double)(rand() % 100) : shared_state;
    }
    v[CLOCK] += step_size;
    v[CALLS] += 1.0;
}

int fmi2DoStep(Model *me, double time, double step_size, int no_set_state) {
    me->values[RETURNS] = !no_set_state;
    if (me->stopped) {
        return 2;
    }
    advance(me, step_size);
    if (is(me, "overruns")) {
        ((char *)me->history)[8 * sizeof *me->history] = 1;
    }
    if (me->stop_after > 0.0 && me->values[CLOCK] >= me->stop_after) {
        me->stopped = 1;
        return 2;
    }
    return 0;
}

int fmi2GetBooleanStatus(Model *me, int kind, int *value) {
    *value = me->stopped;
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
    const Model before = *me;

    me->resets++;
    if (is(me, "reset does nothing")) {
        return 0;
    }
    if (is(me, "second reset fails") && me->resets > 1) {
        return 3;
    }
    set_start(me);
    if (is(me, "reset keeps the state")) {
        me->values[Y] = before.values[Y];
    } else if (is(me, "reset keeps inputs")) {
        me->values[U] = before.values[U];
    } else if (is(me, "reset keeps parameters")) {
        me->values[GAIN] = before.values[GAIN];
    } else if (is(me, "reset keeps the time")) {
        me->values[CLOCK] = before.values[CLOCK];
    } else if (is(me, "stops, reset keeps that")) {
        me->stopped = before.stopped;
    } else if (is(me, "reset frees twice")) {
        free(me->history);
    } else if (is(me, "reset is not exact")) {
        me->values[Y] = 1e-9 * before.values[CALLS];
    }
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
    const double y = me->values[Y];

    memcpy(me, state, sizeof *me);
    if (is(me, "restore forgets")) {
        me->values[Y] = y;
    } else if (is(me, "restore keeps the time")) {
        me->values[CLOCK] += 1.0;
    }
    return 0;
}

int fmi2FreeFMUstate(Model *me, void **state) {
    free(*state);
    *state = NULL;
    return 0;
}
