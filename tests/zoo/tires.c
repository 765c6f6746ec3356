/* FMUs whose instances begin anew at first, and later no more: what tires is in the
   token, as words in any order.

   "reset", "restore", "instance": after LIMIT calls, or with later instances, an error shows in the
   first step.
   "stubborn": a reset does nothing from the start.
   "noise": every step adds a random number if the environment variable TIRES_NOISE is set.
   "crash": the process ends if the first step of all instances has an input of 1.
   "fails", "warns": instead of another value, the step returns Error or Warning.
   y' = gain u. Reals: 0 "u" (input), 1 "y" (output), 2 "gain" (parameter). */

#include "zoo.h"

#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { LIMIT = 60, U = 0, Y, GAIN, VALUES };

struct Animal {
    double values[VALUES];
    double keep; /* added in the first step after something tired */
    int resets, restores;
    char token[60];
};

static int instances, has_stepped;

static bool is(const Animal *me, const char *word) {
    return strstr(me->token, word) != NULL;
}

static void set_start(Animal *me) {
    memset(me->values, 0, sizeof me->values);
    me->values[GAIN] = 1.0;
}

Animal *zoo_instantiate(const Birth *birth) {
    Animal *me = calloc(1, sizeof *me);

    strncpy(me->token, birth->token, sizeof me->token - 1);
    set_start(me);
    instances++;
    me->keep = is(me, "instance") && instances > LIMIT ? 0.5 : 0.0;
    return me;
}

void zoo_free(Animal *me) {
    free(me);
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
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
        return ERROR;
    }
    const bool warns = me->keep > 0.0 && is(me, "warns");
    v[Y] += step_size * v[GAIN] * v[U] + (warns ? 0.0 : me->keep);
    me->keep = 0.0;
    return warns ? WARNING : OK;
}

int zoo_get(Animal *me, const unsigned *references, size_t count, double *values) {
    zoo_read(me->values, references, count, values);
    return OK;
}

int zoo_set(Animal *me, const unsigned *references, size_t count, const double *values) {
    zoo_write(me->values, references, count, values);
    return OK;
}

int zoo_reset(Animal *me) {
    if (is(me, "stubborn")) {
        return OK;
    }
    set_start(me);
    me->keep = is(me, "reset") && ++me->resets > LIMIT ? 0.5 : 0.0;
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
    const Animal before = *me;

    memcpy(me, state, sizeof *me);
    me->restores = before.restores + 1;
    me->keep = is(me, "restore") && me->restores > LIMIT ? 0.5 : 0.0;
    return OK;
}
