/* An FMU of FMI 3.0 with all kinds of clocks, for model exchange and for co-simulation with event
   mode. It breaks off if a call comes in the wrong mode, if a step passes a tick or an alarm, and if
   a clocked input is set while its clock does not tick.

   x' = 1 from x = 0. An alarm at each whole number plus 0.3 starts the countdown.

   With FRACTIONS, its intervals are fractions, and it has no functions for decimals. */

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { OK, WARNING, DISCARD, ERROR };
enum { INSTANTIATED, INITIALIZING, EVENT, CONTINUOUS };

/* Value references: clocks, their counts, the times of their last ticks, and others. */
enum { CONSTANT, FIXED, CALCULATED, TUNABLE, CHANGING, COUNTDOWN, STRIKE, BELL, CLOCKS };
enum { COUNT = 10, LAST = 20, X = 30, DER_X, PERIOD, PACE, COMMAND, SAMPLE, PLAIN, EAGER, ALARM, BAD };
enum { COMMANDS = 40, SAMPLES, PLAINS, END_OF_ARRAYS, SIZE = 2 }; /* arrays */

typedef void Update(void *environment, double time, bool set, bool get, bool finished, bool early,
                    bool *early_requested, double *early_time);

typedef struct {
    int mode;
    bool exchange, active[CLOCKS], counts_down;
    double time, x, next_alarm, countdown;
    double fixed_interval, period, pace, command, sample, plain, eager, alarms, bad_counter;
    double count[CLOCKS], last[CLOCKS], commands[SIZE], samples[SIZE], plains[SIZE];
} Model;

#define REQUIRE(condition)                                                                         \
    if (!(condition)) {                                                                            \
        return ERROR;                                                                              \
    }

static void start(Model *me) {
    const Model kept = *me;

    memset(me, 0, sizeof *me);
    me->exchange = kept.exchange;
    me->period = 0.2;
    me->pace = 0.5;
    me->next_alarm = 0.3;
    for (int i = 0; i < CLOCKS; i++) {
        me->last[i] = -1.0;
    }
}

static void *make(bool exchange) {
    Model *me = calloc(1, sizeof *me);

    me->exchange = exchange;
    start(me);
    return me;
}

void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources,
                                   bool visible, bool logging, void *environment, void *logger) {
    return make(true);
}

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                  bool visible, bool logging, bool event_mode, bool early_return,
                                  const unsigned *intermediate, size_t intermediate_count,
                                  void *environment, void *logger, Update *update) {
    bool wants_early_return = true;
    double early_return_time = 0.0;

    update(environment, 0.0, false, false, true, true, &wants_early_return, &early_return_time);
    if (!event_mode || !early_return || wants_early_return) {
        return NULL;
    }
    return make(false);
}

void fmi3FreeInstance(Model *me) {
    free(me);
}

int fmi3Reset(Model *me) {
    start(me);
    return OK;
}

int fmi3Terminate(Model *me) {
    return OK;
}

int fmi3EnterInitializationMode(Model *me, bool has_tolerance, double tolerance, double time,
                                bool has_stop, double stop) {
    REQUIRE(me->mode == INSTANTIATED);
    me->mode = INITIALIZING;
    me->time = me->x = time;
    me->next_alarm = floor(time) + 0.3;
    return OK;
}

int fmi3ExitInitializationMode(Model *me) {
    REQUIRE(me->mode == INITIALIZING && me->fixed_interval > 0.0);
    me->mode = EVENT;
    return OK;
}

int fmi3EnterEventMode(Model *me) {
    REQUIRE(me->mode == CONTINUOUS);
    me->mode = EVENT;
    return OK;
}

static int leave(Model *me) {
    REQUIRE(me->mode == EVENT);
    me->mode = CONTINUOUS;
    return OK;
}

int fmi3EnterStepMode(Model *me) {
    return me->exchange ? ERROR : leave(me);
}

int fmi3EnterContinuousTimeMode(Model *me) {
    return me->exchange ? leave(me) : ERROR;
}

/* Clocks */

#ifdef FRACTIONS

static const double OF_CONSTANT = 1.0 / 3;

int fmi3GetIntervalFraction(Model *me, const unsigned *references, size_t count,
                            uint64_t *counters, uint64_t *resolutions, int *qualifiers) {
    REQUIRE(me->mode == INITIALIZING || me->mode == EVENT);
    REQUIRE(count == 1 && references[0] >= CALCULATED && references[0] <= COUNTDOWN);
    qualifiers[0] = 2;
    if (references[0] == CALCULATED) {
        counters[0] = me->bad_counter > 0.0 ? (uint64_t)me->bad_counter : SCALE;
        resolutions[0] = me->bad_counter > 0.0 ? 0 : 3 * SCALE;
    } else if (references[0] == TUNABLE) {
        counters[0] = SCALE;
        resolutions[0] = (fmod(me->count[TUNABLE], 2.0) == 0.0 ? 3 : 4) * SCALE;
    } else if (references[0] == CHANGING) {
        counters[0] = 1 + (uint64_t)me->count[CHANGING];
        resolutions[0] = 30;
    } else {
        counters[0] = 250;
        resolutions[0] = 1000;
        qualifiers[0] = me->countdown > 0.0 ? 2 : me->counts_down;
        me->countdown = 0.0;
    }
    return OK;
}

int fmi3GetShiftFraction(Model *me, const unsigned *references, size_t count, uint64_t *counters,
                         uint64_t *resolutions) {
    REQUIRE(me->mode == INITIALIZING && count == 1 && references[0] == CALCULATED);
    counters[0] = 1;
    resolutions[0] = 7;
    return OK;
}

int fmi3SetIntervalFraction(Model *me, const unsigned *references, size_t count,
                            const uint64_t *counters, const uint64_t *resolutions) {
    REQUIRE(me->mode == INITIALIZING && count == 1 && references[0] == FIXED);
    REQUIRE(counters[0] == 1 && resolutions[0] == 7);
    me->fixed_interval = 1.0 / 7;
    return OK;
}

int fmi3GetIntervalDecimal(Model *me) {
    return ERROR;
}

int fmi3GetShiftDecimal(Model *me) {
    return ERROR;
}

int fmi3SetIntervalDecimal(Model *me) {
    return ERROR;
}

#else

static const double OF_CONSTANT = 0.1;

static double interval_of(const Model *me, unsigned clock) {
    return clock == CALCULATED ? me->period
           : clock == TUNABLE  ? me->pace
                               : 0.1 * (1.0 + me->count[CHANGING]);
}

int fmi3GetIntervalDecimal(Model *me, const unsigned *references, size_t count, double *intervals,
                           int *qualifiers) {
    REQUIRE(me->mode == INITIALIZING || me->mode == EVENT);
    for (size_t i = 0; i < count; i++) {
        REQUIRE(references[i] >= CALCULATED && references[i] <= COUNTDOWN);
        if (references[i] == COUNTDOWN) {
            intervals[i] = me->countdown;
            qualifiers[i] = me->countdown > 0.0 ? 2 : me->counts_down;
            me->countdown = 0.0;
        } else {
            intervals[i] = interval_of(me, references[i]);
            qualifiers[i] = 2;
        }
    }
    return OK;
}

int fmi3GetShiftDecimal(Model *me, const unsigned *references, size_t count, double *shifts) {
    REQUIRE(me->mode == INITIALIZING && count == 1 && references[0] == CALCULATED);
    shifts[0] = 0.5 * me->period;
    return OK;
}

int fmi3SetIntervalDecimal(Model *me, const unsigned *references, size_t count,
                           const double *intervals) {
    REQUIRE(me->mode == INITIALIZING && count == 1 && references[0] == FIXED);
    me->fixed_interval = intervals[0];
    return OK;
}

int fmi3GetIntervalFraction(Model *me) {
    return ERROR;
}

int fmi3GetShiftFraction(Model *me) {
    return ERROR;
}

int fmi3SetIntervalFraction(Model *me) {
    return ERROR;
}

#endif

int fmi3SetClock(Model *me, const unsigned *references, size_t count, const bool *values) {
    REQUIRE(me->mode == EVENT);
    for (size_t i = 0; i < count; i++) {
        REQUIRE(references[i] < BELL);
        me->active[references[i]] = values[i];
    }
    return OK;
}

/* The bell rings at every third tick of the constant clock. */
int fmi3GetClock(Model *me, const unsigned *references, size_t count, bool *values) {
    REQUIRE(me->mode == EVENT && count == 1 && references[0] == BELL);
    values[0] = me->active[CONSTANT] && fmod(me->count[CONSTANT], 3.0) == 2.0;
    me->active[BELL] |= values[0];
    return OK;
}

int fmi3UpdateDiscreteStates(Model *me, bool *again, bool *terminate, bool *nominals_changed,
                             bool *states_changed, bool *has_next, double *next) {
    REQUIRE(me->mode == EVENT);
    if (me->time >= me->next_alarm) {
        me->next_alarm += 1.0;
        me->alarms++;
        me->countdown = 0.25;
        me->counts_down = true;
    }
    if (me->active[CONSTANT]) {
        me->sample = me->command;
        memcpy(me->samples, me->commands, sizeof me->samples);
    }
    if (me->active[COUNTDOWN]) {
        me->counts_down = false;
    }
    for (int i = 0; i < CLOCKS; i++) {
        if (me->active[i]) {
            me->count[i]++;
            me->last[i] = me->time;
        }
        me->active[i] = false;
    }
    *again = *terminate = *nominals_changed = *states_changed = false;
    *has_next = me->exchange;
    *next = me->next_alarm;
    return OK;
}

/* Values */

static double *place_of(Model *me, unsigned reference) {
    switch (reference) {
    case X: return &me->x;
    case PERIOD: return &me->period;
    case PACE: return &me->pace;
    case COMMAND: return &me->command;
    case SAMPLE: return &me->sample;
    case PLAIN: return &me->plain;
    case EAGER: return &me->eager;
    case ALARM: return &me->alarms;
    case BAD: return &me->bad_counter;
    case COMMANDS: return me->commands;
    case SAMPLES: return me->samples;
    case PLAINS: return me->plains;
    }
    if (reference >= COUNT && reference < COUNT + CLOCKS) {
        return &me->count[reference - COUNT];
    }
    if (reference >= LAST && reference < LAST + CLOCKS) {
        return &me->last[reference - LAST];
    }
    return NULL;
}

static size_t size_of(unsigned reference) {
    return reference >= COMMANDS && reference < END_OF_ARRAYS ? SIZE : 1;
}

static bool is_clocked(unsigned reference) {
    return reference == COMMAND || reference == COMMANDS;
}

int fmi3GetFloat64(Model *me, const unsigned *references, size_t count, double *values,
                   size_t number_of_values) {
    size_t done = 0;

    for (size_t i = 0; i < count; done += size_of(references[i++])) {
        const double *place = place_of(me, references[i]);
        REQUIRE(place != NULL && done + size_of(references[i]) <= number_of_values);
        memcpy(values + done, place, size_of(references[i]) * sizeof *place);
    }
    return done == number_of_values ? OK : ERROR;
}

int fmi3SetFloat64(Model *me, const unsigned *references, size_t count, const double *values,
                   size_t number_of_values) {
    size_t done = 0;

    REQUIRE(me->mode != CONTINUOUS);
    for (size_t i = 0; i < count; done += size_of(references[i++])) {
        double *place = place_of(me, references[i]);
        REQUIRE(place != NULL && done + size_of(references[i]) <= number_of_values);
        REQUIRE(!is_clocked(references[i]) || me->mode == INSTANTIATED || me->active[CONSTANT]);
        memcpy(place, values + done, size_of(references[i]) * sizeof *place);
    }
    return done == number_of_values ? OK : ERROR;
}

/* Co-simulation */

int fmi3DoStep(Model *me, double time, double step, bool no_set_state, bool *event,
               bool *terminate, bool *early, double *reached) {
    const double until = time + step;

    REQUIRE(me->mode == CONTINUOUS && fabs(time - me->time) < 1e-9 && step > 0.0);
    REQUIRE(me->last[CONSTANT] < 0.0 || until < me->last[CONSTANT] + OF_CONSTANT + 1e-9);
    me->time = me->eager > 0.0 ? fmin(until, time + me->eager) : until;
    *event = me->time >= me->next_alarm;
    me->time = *event ? me->next_alarm : me->time;
    me->x = me->time;
    *early = me->time < until;
    *reached = me->time;
    *terminate = false;
    return OK;
}

/* Model exchange */

int fmi3SetTime(Model *me, double time) {
    REQUIRE(me->mode == CONTINUOUS && time <= me->next_alarm + 1e-9);
    me->time = time;
    return OK;
}

int fmi3SetContinuousStates(Model *me, const double *x, size_t count) {
    REQUIRE(me->mode == CONTINUOUS && count == 1);
    me->x = x[0];
    return OK;
}

int fmi3GetContinuousStates(Model *me, double *x, size_t count) {
    x[0] = me->x;
    return OK;
}

int fmi3GetContinuousStateDerivatives(Model *me, double *rates, size_t count) {
    rates[0] = 1.0;
    return OK;
}

int fmi3GetNominalsOfContinuousStates(Model *me, double *x, size_t count) {
    x[0] = 1.0;
    return OK;
}

int fmi3GetEventIndicators(Model *me, double *z, size_t count) {
    return OK;
}

int fmi3CompletedIntegratorStep(Model *me, bool no_set_state, bool *event, bool *terminate) {
    *event = *terminate = false;
    return OK;
}

/* States */

int fmi3GetFMUState(Model *me, void **state) {
    *state = *state == NULL ? malloc(sizeof *me) : *state;
    memcpy(*state, me, sizeof *me);
    return OK;
}

int fmi3SetFMUState(Model *me, const void *state) {
    memcpy(me, state, sizeof *me);
    return OK;
}

int fmi3FreeFMUState(Model *me, void **state) {
    free(*state);
    *state = NULL;
    return OK;
}

int fmi3SerializedFMUStateSize(Model *me, void *state, size_t *size) {
    *size = sizeof *me;
    return OK;
}

int fmi3SerializeFMUState(Model *me, void *state, unsigned char *bytes, size_t size) {
    memcpy(bytes, state, size);
    return OK;
}

int fmi3DeserializeFMUState(Model *me, const unsigned char *bytes, size_t size, void **state) {
    *state = malloc(size);
    memcpy(*state, bytes, size);
    return OK;
}

const char *fmi3GetVersion(void) {
    return "3.0";
}

#define STUB(name)                                                                                 \
    int name(void) {                                                                               \
        return ERROR;                                                                              \
    }
#include STUBS
