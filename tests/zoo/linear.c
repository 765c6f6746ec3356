/* Linear equations: x' = A x + B u, y = C x + D u with two states, two inputs and two outputs. The
   classical Runge-Kutta method does INNER steps in a communication step. Outputs follow the inputs
   at once.

   A step that is longer than "limit" is discarded unless that is 0; the step that ends after
   "fails" returns "status" unless that is 0, or asks for the end if "status" is 1. */

#include "zoo.h"

#include <stdlib.h>
#include <string.h>

enum { INNER = 20, TIME = 0, U = 1, Y = 3, X0 = 5, A = 7, B = 11, C = 15, D = 19, LIMIT = 23, FAILS,
       STATE, VALUES };

struct Animal {
    double values[VALUES];
    double x[2], time;
    bool stops;
};

Animal *zoo_instantiate(const Birth *birth) {
    return calloc(1, sizeof(Animal));
}

void zoo_free(Animal *me) {
    free(me);
}

int zoo_exit(Animal *me) {
    memcpy(me->x, me->values + X0, sizeof me->x);
    return OK;
}

static void rates(const double *v, const double *x, double *dx) {
    for (int i = 0; i < 2; i++) {
        dx[i] = v[A + 2 * i] * x[0] + v[A + 2 * i + 1] * x[1] + v[B + 2 * i] * v[U] +
                v[B + 2 * i + 1] * v[U + 1];
    }
}

static void advance(Animal *me, double h) {
    static const double fractions[] = {0.5, 0.5, 1.0};
    double k[4][2], x[2];

    rates(me->values, me->x, k[0]);
    for (int stage = 1; stage < 4; stage++) {
        for (int i = 0; i < 2; i++) {
            x[i] = me->x[i] + h * fractions[stage - 1] * k[stage - 1][i];
        }
        rates(me->values, x, k[stage]);
    }
    for (int i = 0; i < 2; i++) {
        me->x[i] += h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
    }
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    const double *v = me->values;

    if (v[LIMIT] > 0 && step_size > v[LIMIT]) {
        return DISCARD;
    }
    for (int i = 0; i < INNER; i++) {
        advance(me, step_size / INNER);
    }
    me->time += step_size;
    if (v[STATE] != 0 && me->time > v[FAILS]) {
        me->stops = v[STATE] == WARNING;
        return !me->stops ? (int)v[STATE] : FMI_VERSION == 3 ? OK : DISCARD;
    }
    return OK;
}

bool zoo_stops(const Animal *me) {
    return me->stops;
}

static double output(const Animal *me, int i) {
    const double *v = me->values;
    const double *x = me->time == 0 ? v + X0 : me->x; /* in Initialization Mode, too */
    return v[C + 2 * i] * x[0] + v[C + 2 * i + 1] * x[1] + v[D + 2 * i] * v[U] +
           v[D + 2 * i + 1] * v[U + 1];
}

int zoo_get(Animal *me, const unsigned *references, size_t count, double *values) {
    me->values[TIME] = me->time;
    me->values[Y] = output(me, 0);
    me->values[Y + 1] = output(me, 1);
    zoo_read(me->values, references, count, values);
    return OK;
}

int zoo_set(Animal *me, const unsigned *references, size_t count, const double *values) {
    zoo_write(me->values, references, count, values);
    return OK;
}

int zoo_reset(Animal *me) {
    memset(me, 0, sizeof *me);
    return OK;
}

int zoo_get_state(Animal *me, void **state) {
    if (*state == NULL) {
        *state = malloc(sizeof *me);
    }
    memcpy(*state, me, sizeof *me);
    return OK;
}

int zoo_set_state(Animal *me, void *state) {
    memcpy(me, state, sizeof *me);
    return OK;
}

int zoo_size_of_bytes(Animal *me, void *state, size_t *size) {
    *size = sizeof *me;
    return OK;
}

int zoo_to_bytes(Animal *me, void *state, char *bytes, size_t size) {
    memcpy(bytes, state, sizeof *me);
    return OK;
}

int zoo_from_bytes(Animal *me, const char *bytes, size_t size, void **state) {
    *state = malloc(sizeof *me);
    memcpy(*state, bytes, sizeof *me);
    return OK;
}
