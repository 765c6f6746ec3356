/* Clocks of an instance: their intervals, ticks and activation. */

#include "model_exchange/clock.h"

#include <float.h>
#include <inttypes.h>
#include <math.h>
#include <string.h>

#include "model_exchange/solver.h"

/* FMI's interval qualifiers */
enum { NOT_YET_KNOWN, UNCHANGED, CHANGED };

static Status missing(Solver *me, const Clock *clock) {
    return solver_fail(me, "the FMU lacks a function for its clock with value reference %u",
                       (unsigned)clock->reference);
}

/* A clock that repeats too soon would never let time pass. */
static Status check_interval(Solver *me, const Clock *clock, const Interval *interval) {
    const bool may_be_zero = clock->kind == CLOCK_COUNTDOWN;

    if (may_be_zero ? interval->seconds >= 0.0 : interval->seconds > 0.0) {
        return STATUS_OK;
    }
    return solver_fail(me, "the clock with value reference %u has an interval of %g s at t = %g s",
                       (unsigned)clock->reference, interval->seconds, me->memory.time);
}

static Status take_fraction(Solver *me, const Clock *clock, uint64_t counter, uint64_t resolution,
                            Interval *interval) {
    if (interval_of(counter, resolution, interval)) {
        return STATUS_OK;
    }
    return solver_fail(me,
                       "the clock with value reference %u has an interval or shift of "
                       "%" PRIu64 "/%" PRIu64 " s at t = %g s",
                       (unsigned)clock->reference, counter, resolution, me->memory.time);
}

static Status worse(Status a, Status b) {
    return a > b ? a : b;
}

static Status ask_decimal(Solver *me, const Clock *clock, Interval *interval, int *qualifier) {
    const ClockFunctions *f = me->clock_functions;
    double seconds = 0.0;

    if (f->get_interval == NULL) {
        return missing(me, clock);
    }
    const Status status =
        sane(f->get_interval(me->component, &clock->reference, 1, &seconds, qualifier));
    solver_restore_floats(me);
    if (*qualifier == CHANGED) {
        *interval = (Interval){.seconds = seconds};
    }
    return status;
}

static Status ask_fraction(Solver *me, const Clock *clock, Interval *interval, int *qualifier) {
    const ClockFunctions *f = me->clock_functions;
    uint64_t counter = 0, resolution = 0;

    if (f->get_interval_fraction == NULL) {
        return missing(me, clock);
    }
    const Status status = sane(f->get_interval_fraction(me->component, &clock->reference, 1,
                                                        &counter, &resolution, qualifier));
    solver_restore_floats(me);
    return status <= STATUS_WARNING && *qualifier == CHANGED
               ? worse(status, take_fraction(me, clock, counter, resolution, interval))
               : status;
}

/* Asks for the interval. It stays as it is if the FMU tells no other one. */
static Status ask_interval(Solver *me, const Clock *clock, Interval *interval, int *qualifier) {
    *qualifier = NOT_YET_KNOWN;
    const Status status = clock->by_fractions ? ask_fraction(me, clock, interval, qualifier)
                                              : ask_decimal(me, clock, interval, qualifier);
    return status <= STATUS_WARNING && *qualifier == CHANGED
               ? worse(status, check_interval(me, clock, interval))
               : status;
}

static Status ask_shift(Solver *me, const Clock *clock, Interval *shift) {
    const ClockFunctions *f = me->clock_functions;
    uint64_t counter = 0, resolution = 0;
    Status status;

    if (clock->by_fractions ? f->get_shift_fraction == NULL : f->get_shift == NULL) {
        return missing(me, clock);
    }
    *shift = (Interval){.seconds = 0.0};
    status = sane(clock->by_fractions
                      ? f->get_shift_fraction(me->component, &clock->reference, 1, &counter,
                                              &resolution)
                      : f->get_shift(me->component, &clock->reference, 1, &shift->seconds));
    solver_restore_floats(me);
    return status <= STATUS_WARNING && clock->by_fractions
               ? worse(status, take_fraction(me, clock, counter, resolution, shift))
               : status;
}

static Status set_interval(Solver *me, const Clock *clock) {
    const ClockFunctions *f = me->clock_functions;
    const bool by_fraction = clock->by_fractions && clock->interval.resolution > 0;
    const uint64_t counter = (uint64_t)clock->interval.counter;
    const uint64_t resolution = (uint64_t)clock->interval.resolution;

    if (by_fraction ? f->set_interval_fraction == NULL : f->set_interval == NULL) {
        return missing(me, clock);
    }
    const Status status = sane(
        by_fraction
            ? f->set_interval_fraction(me->component, &clock->reference, 1, &counter, &resolution)
            : f->set_interval(me->component, &clock->reference, 1, &clock->interval.seconds));
    solver_restore_floats(me);
    return status;
}

/* The first tick comes after the shift, others after intervals. */
static Ticks first_ticks(double time, Interval shift, Interval interval) {
    Ticks ticks = {.origin = time, .interval = shift, .passed = shift.counter};

    if (interval.resolution > 0 && shift.resolution > 0) {
        ticks_change(&ticks, interval);
        return ticks;
    }
    return (Ticks){.origin = time + shift.seconds, .interval = interval};
}

static Status prepare(Solver *me, const Clock *clock, Ticks *ticks) {
    const bool never = clock->kind >= CLOCK_COUNTDOWN;
    Interval interval = clock->interval, shift = clock->shift;
    Status status = STATUS_OK;
    int qualifier;

    if (clock->kind == CLOCK_CONSTANT || clock->kind == CLOCK_FIXED) {
        status = check_interval(me, clock, &interval); /* the XML may give none */
    }
    if (clock->kind == CLOCK_FIXED && status <= STATUS_WARNING) {
        status = set_interval(me, clock);
    } else if (clock->kind >= CLOCK_CALCULATED && clock->kind <= CLOCK_CHANGING) {
        status = ask_interval(me, clock, &interval, &qualifier);
    }
    if (status <= STATUS_WARNING && isnan(shift.seconds)) {
        status = ask_shift(me, clock, &shift);
    }
    *ticks = never ? (Ticks){.origin = INFINITY} : first_ticks(me->memory.time, shift, interval);
    return status;
}

Status clocks_prepare(Solver *me) {
    const Solving *s = me->solving;
    Status status = STATUS_OK;

    for (size_t i = 0; i < s->number_of_clocks && status <= STATUS_WARNING; i++) {
        me->active[i] = false;
        status = prepare(me, &s->clocks[i], &me->ticks[i]);
    }
    return status;
}

void clocks_begin_step(Solver *me) {
    for (size_t i = 0; i < me->solving->number_of_clocks; i++) {
        me->ticks[i].ticked = 0;
    }
}

/* Whether two times differ by no more than their rounding. */
static bool is_due(const Solver *me, const Ticks *ticks) {
    return ticks_next(ticks) <= me->memory.time + 16.0 * DBL_EPSILON * fabs(me->memory.time);
}

static Status activate(Solver *me, size_t index) {
    const Clock *clock = &me->solving->clocks[index];
    const bool active = true;

    if (me->clock_functions->set == NULL) {
        return missing(me, clock);
    }
    me->ticks[index].ticked = 1;
    const Status status =
        sane(me->clock_functions->set(me->component, &clock->reference, 1, &active));
    solver_restore_floats(me);
    return status;
}

Status clocks_activate(Solver *me) {
    const size_t count = me->solving->number_of_clocks;
    Status status = STATUS_OK;

    for (size_t i = 0; i < count && status <= STATUS_WARNING; i++) {
        me->active[i] |= is_due(me, &me->ticks[i]);
        status = me->active[i] ? activate(me, i) : status;
    }
    for (size_t i = 0; i < count && status <= STATUS_WARNING; i++) {
        status = me->active[i] ? me->set_clocked(me, i) : status;
    }
    return status;
}

Status clocks_watch(Solver *me) {
    const Solving *s = me->solving;
    Status status = STATUS_OK;

    for (size_t i = 0; i < s->number_of_clocks && status <= STATUS_WARNING; i++) {
        bool active = false;
        if (s->clocks[i].kind != CLOCK_OUTPUT) {
            continue;
        }
        if (me->clock_functions->get == NULL) {
            return missing(me, &s->clocks[i]);
        }
        status = sane(
            me->clock_functions->get(me->component, &s->clocks[i].reference, 1, &active));
        solver_restore_floats(me);
        me->ticks[i].ticked |= active;
    }
    return status;
}

static Status plan_countdown(Solver *me, const Clock *clock, Ticks *ticks, bool ticked) {
    Interval interval = {.seconds = 0.0};
    int qualifier;
    const Status status = ask_interval(me, clock, &interval, &qualifier);

    if (qualifier == CHANGED) {
        ticks->origin = me->memory.time + interval.seconds;
    } else if (qualifier == NOT_YET_KNOWN || ticked) {
        ticks->origin = INFINITY;
    }
    return status;
}

/* A new interval begins with the tick at which the FMU tells it. */
static Status plan_after_tick(Solver *me, const Clock *clock, Ticks *ticks) {
    const bool may_change = clock->kind == CLOCK_TUNABLE || clock->kind == CLOCK_CHANGING;
    Interval interval = ticks->interval;
    Status status = STATUS_OK;
    int qualifier = UNCHANGED;

    if (may_change) {
        status = ask_interval(me, clock, &interval, &qualifier);
    }
    if (memcmp(&interval, &ticks->interval, sizeof interval) != 0) {
        ticks_change(ticks, interval);
    }
    ticks_advance(ticks);
    return status > STATUS_WARNING ? status : check_interval(me, clock, &ticks->interval);
}

Status clocks_plan(Solver *me) {
    const Solving *s = me->solving;
    Status status = STATUS_OK;

    for (size_t i = 0; i < s->number_of_clocks && status <= STATUS_WARNING; i++) {
        const bool ticked = me->active[i];
        me->active[i] = false;
        if (s->clocks[i].kind == CLOCK_COUNTDOWN) {
            status = plan_countdown(me, &s->clocks[i], &me->ticks[i], ticked);
        } else if (ticked && s->clocks[i].kind < CLOCK_COUNTDOWN) {
            status = plan_after_tick(me, &s->clocks[i], &me->ticks[i]);
        }
    }
    return status;
}

double clocks_next(const Solver *me) {
    double next = INFINITY;

    for (size_t i = 0; i < me->solving->number_of_clocks; i++) {
        next = fmin(next, ticks_next(&me->ticks[i]));
    }
    return next;
}

void clocks_ask(Solver *me, const uint32_t *references, size_t count, const bool *values) {
    const Solving *s = me->solving;

    for (size_t i = 0; i < s->number_of_clocks; i++) {
        for (size_t j = 0; j < count && s->clocks[i].kind == CLOCK_TRIGGERED; j++) {
            me->active[i] |= references[j] == s->clocks[i].reference && values[j];
        }
    }
}

void clocks_tell(const Solver *me, const uint32_t *references, size_t count, bool *values) {
    const Solving *s = me->solving;

    for (size_t j = 0; j < count; j++) {
        values[j] = false;
        for (size_t i = 0; i < s->number_of_clocks; i++) {
            values[j] |= references[j] == s->clocks[i].reference && me->ticks[i].ticked != 0;
        }
    }
}

bool clocks_own(const Solver *me, uint32_t reference) {
    const Solving *s = me->solving;
    bool own = false;

    for (size_t i = 0; i < s->number_of_clocked; i++) {
        own |= s->clocked[i].reference == reference && s->clocked[i].clock != NO_CLOCK;
    }
    return own;
}
