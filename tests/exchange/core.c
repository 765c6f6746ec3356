/* The rules of model exchange, and a co-simulation of the same model by small Euler steps. */

#include "exchange.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifndef INTERNAL_STEP
#define INTERNAL_STEP 1e-3
#endif

#define REQUIRE(condition)                                                                         \
    if (!(condition)) {                                                                            \
        if (getenv("FMUGYM_TESTS_TRACE") != NULL) {                                                \
            fprintf(stderr, "%s: %s in mode %d\n", __func__, #condition, me->mode);                \
        }                                                                                          \
        return ERROR;                                                                              \
    }

static void start(Model *me) {
    memset(me->v, 0, sizeof me->v);
    me->mode = INSTANTIATED;
    me->stops = me->again = me->wants_event = false;
    me->next_event = me->stop = INFINITY;
    me->time = me->completed = 0.0;
    model_start(me);
}

Model *core_new(const char *name, bool exchange, void *logger, void *environment) {
    Model *me = calloc(1, sizeof *me);

    snprintf(me->name, sizeof me->name, "%s", name);
    me->exchange = exchange;
    me->logger = logger;
    me->environment = environment;
    start(me);
    return me;
}

int core_reset(Model *me) {
    start(me);
    return OK;
}

int core_enter_initialization(Model *me, double time) {
    REQUIRE(me->mode == INSTANTIATED);
    me->mode = INITIALIZING;
    me->time = me->completed = time;
    return OK;
}

int core_exit_initialization(Model *me) {
    REQUIRE(me->mode == INITIALIZING);
    model_initialize(me);
    model_rates(me);
    me->mode = me->exchange ? EVENT : STEPPING;
    return OK;
}

int core_enter_events(Model *me) {
    REQUIRE(me->mode == CONTINUOUS);
    me->mode = EVENT;
    return OK;
}

int core_update(Model *me) {
    REQUIRE(me->mode == EVENT);
    me->again = false;
    model_event(me);
    model_rates(me);
    me->stops |= me->time >= me->stop - 1e-12;
    return OK;
}

int core_enter_continuous(Model *me) {
    REQUIRE(me->mode == EVENT && !me->again && !me->stops);
    me->mode = CONTINUOUS;
    me->completed = me->time;
    return OK;
}

int core_complete(Model *me) {
    REQUIRE(me->mode == CONTINUOUS);
    me->completed = me->time;
    me->wants_event = false;
    model_complete(me);
    return OK;
}

int core_set_time(Model *me, double time) {
    REQUIRE(me->mode == CONTINUOUS && time >= me->completed);
    me->time = time;
    return OK;
}

int core_set_states(Model *me, const double *x, size_t count) {
    REQUIRE(me->mode == CONTINUOUS && count == STATES);
    memcpy(me->v, x, count * sizeof *x);
    return OK;
}

int core_get_states(Model *me, double *x, size_t count) {
    REQUIRE((me->mode == CONTINUOUS || me->mode == EVENT) && count == STATES);
    memcpy(x, me->v, count * sizeof *x);
    return OK;
}

int core_rates(Model *me, double *rates, size_t count) {
    REQUIRE((me->mode == CONTINUOUS || me->mode == EVENT) && count == STATES);
    me->status = OK;
    model_rates(me);
    memcpy(rates, me->v + STATES, count * sizeof *rates);
    return me->status;
}

int core_indicators(Model *me, double *z, size_t count) {
    REQUIRE((me->mode == CONTINUOUS || me->mode == EVENT) && count == INDICATORS);
    model_rates(me);
    model_indicators(me, z);
    return OK;
}

int core_nominals(Model *me, double *x, size_t count) {
    REQUIRE((me->mode == CONTINUOUS || me->mode == EVENT) && count == STATES);
    for (size_t i = 0; i < count; i++) {
        x[i] = 1.0;
    }
    return OK;
}

int core_get(Model *me, const unsigned *references, size_t count, double *values) {
    REQUIRE(me->mode != INSTANTIATED);
    model_rates(me);
    for (size_t i = 0; i < count; i++) {
        values[i] = me->v[references[i]];
    }
    return OK;
}

int core_set(Model *me, const unsigned *references, size_t count, const double *values) {
    REQUIRE(me->mode != CONTINUOUS && me->mode != TERMINATED);
    for (size_t i = 0; i < count; i++) {
        me->v[references[i]] = values[i];
    }
    return OK;
}

/* Co-simulation */

static bool step_once(Model *me, double until) {
    const double step = fmin(INTERNAL_STEP, until - me->time);
    double before[MOST], after[MOST];
    bool event = false;

    model_rates(me);
    model_indicators(me, before);
    for (size_t i = 0; i < STATES; i++) {
        me->v[i] += step * me->v[STATES + i];
    }
    me->time += step;
    model_rates(me);
    model_indicators(me, after);
    for (size_t i = 0; i < INDICATORS; i++) {
        event |= (before[i] > 0) != (after[i] > 0);
    }
    if (event || me->time >= me->next_event - 1e-12) {
        model_event(me);
    }
    return me->time >= me->stop - 1e-12;
}

/* Does no more of a step than EARLY seconds, and breaks off one that is longer than LONGEST. */
int core_do_step(Model *me, double time, double step) {
    const double until = time + fmin(step, EARLY);

    REQUIRE(me->mode == STEPPING && fabs(time - me->time) < 1e-9);
    me->time = time;
    while (me->time < until - 1e-12) {
        if (step > LONGEST && me->time > time + 0.5 * step) {
            return DISCARD;
        }
        if (step_once(me, until)) {
            me->stops = true;
            return DISCARD;
        }
    }
    return OK;
}

/* FMU states */

int core_get_state(Model *me, void **state) {
    if (*state == NULL) {
        *state = malloc(sizeof *me);
    }
    memcpy(*state, me, sizeof *me);
    return OK;
}

int core_set_state(Model *me, const void *state) {
    Model kept = *me;

    memcpy(me, state, sizeof *me);
    memcpy(me->name, kept.name, sizeof kept.name);
    me->logger = kept.logger;
    me->environment = kept.environment;
    return OK;
}

int core_free_state(void **state) {
    free(*state);
    *state = NULL;
    return OK;
}

int core_to_bytes(const void *state, char *bytes, size_t size) {
    memcpy(bytes, state, size);
    return OK;
}

int core_from_bytes(const char *bytes, size_t size, void **state) {
    *state = malloc(size);
    memcpy(*state, bytes, size);
    return OK;
}

/* Derivatives in the direction of a seed. */
int core_differentiate(Model *me, const unsigned *unknowns, size_t count, const unsigned *knowns,
                       size_t number_of_knowns, const double *seed, double *result) {
    for (size_t i = 0; i < count; i++) {
        result[i] = 0.0;
        for (size_t j = 0; j < number_of_knowns; j++) {
            result[i] += model_partial(me, unknowns[i], knowns[j]) * seed[j];
        }
    }
    return OK;
}
