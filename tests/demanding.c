/* A useful FMU of FMI 2.0 that demands something: what is in its token.

   x' = gain u - x, y = x, by explicit Euler with internal steps of 1 ms.
   Reals: 0 "u" (input), 1 "y" (output), 2 "gain" (parameter), 3 "pid" (output: the process that
   initialized it, if it tells). */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "fmi2_stubs.h"

enum { U, Y, GAIN, PID, VALUES };

typedef struct {
    double values[VALUES];
    char token[40];
} Model;

static double buffer; /* of steps that are not safe in threads */

static int is(const Model *me, const char *token) {
    return strcmp(me->token, token) == 0;
}

static void set_start(Model *me) {
    memset(me->values, 0, sizeof me->values);
    me->values[GAIN] = 1.0;
}

void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                      const void *callbacks, int visible, int logging) {
    Model *me = calloc(1, sizeof *me);

    snprintf(me->token, sizeof me->token, "%s", token);
    set_start(me);
    return me;
}

void fmi2FreeInstance(Model *me) {
    free(me);
}

int fmi2SetupExperiment(Model *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
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
    return rows == 40 ? 0 : 3;
}

int fmi2EnterInitializationMode(Model *me) {
    return 0;
}

int fmi2ExitInitializationMode(Model *me) {
    return is(me, "strtok") ? read_table() : 0;
}

int fmi2DoStep(Model *me, double time, double step_size, int no_set_state) {
    double *v = me->values;
    const int steps = (int)(step_size * 1000.0 + 0.5);

    for (int i = 0; i < steps; i++) {
        buffer = v[GAIN] * v[U] - v[Y];
        if (is(me, "static buffer") && i % 8 == 0) {
            usleep(20);
            v[Y] += 0.001 * buffer;
        } else {
            v[Y] += 0.001 * (v[GAIN] * v[U] - v[Y]);
        }
    }
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
    set_start(me);
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
    memcpy(me, state, sizeof *me);
    return 0;
}

int fmi2FreeFMUstate(Model *me, void **state) {
    free(*state);
    *state = NULL;
    return 0;
}
