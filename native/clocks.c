#include "clock.h"

#include <float.h>
#include <math.h>

#include "solver.h"

/* FMI's interval qualifiers */
enum { NOT_YET_KNOWN, UNCHANGED, CHANGED };

static double next_tick(const Ticks *ticks) {
    return ticks->origin + (double)ticks->count * ticks->interval;
}

static Status missing(Solver *me, const Clock *clock) {
    return solver_fail(me, "the FMU lacks a function for its clock with value reference %u",
                       (unsigned)clock->reference);
}

/* A clock that repeats too soon would never let time pass. */
static Status check_interval(Solver *me, const Clock *clock, double interval) {
    const bool may_be_zero = clock->kind == CLOCK_COUNTDOWN;

    if (may_be_zero ? interval >= 0.0 : interval > 0.0) {
        return STATUS_OK;
    }
    return solver_fail(me, "the clock with value reference %u has an interval of %g s at t = %g s",
                       (unsigned)clock->reference, interval, me->memory.time);
}

/* Asks for the interval. It stays as it is if the FMU tells no other one. */
static Status ask_interval(Solver *me, const Clock *clock, double *interval, int *qualifier) {
    double value = *interval;

    *qualifier = NOT_YET_KNOWN;
    if (me->clock_functions->get_interval == NULL) {
        return missing(me, clock);
    }
    Status status = sane(me->clock_functions->get_interval(me->component, &clock->reference, 1,
                                                           &value, qualifier));
    solver_restore_floats(me);
    if (status <= STATUS_WARNING && *qualifier == CHANGED) {
        const Status checked = check_interval(me, clock, value);
        status = checked > status ? checked : status;
        *interval = value;
    }
    return status;
}

static Status ask_shift(Solver *me, const Clock *clock, double *shift) {
    if (me->clock_functions->get_shift == NULL) {
        return missing(me, clock);
    }
    const Status status =
        sane(me->clock_functions->get_shift(me->component, &clock->reference, 1, shift));
    solver_restore_floats(me);
    return status;
}

static Status set_interval(Solver *me, const Clock *clock) {
    if (me->clock_functions->set_interval == NULL) {
        return missing(me, clock);
    }
    const Status status = sane(me->clock_functions->set_interval(
        me->component, &clock->reference, 1, &clock->interval));
    solver_restore_floats(me);
    return status;
}

static Status prepare(Solver *me, const Clock *clock, Ticks *ticks) {
    const bool never = clock->kind >= CLOCK_COUNTDOWN;
    double interval = clock->interval, shift = clock->shift;
    Status status = STATUS_OK;
    int qualifier;

    if (clock->kind == CLOCK_CONSTANT || clock->kind == CLOCK_FIXED) {
        status = check_interval(me, clock, interval); /* the XML may give none */
    }
    if (clock->kind == CLOCK_FIXED && status <= STATUS_WARNING) {
        status = set_interval(me, clock);
    } else if (clock->kind >= CLOCK_CALCULATED && clock->kind <= CLOCK_CHANGING) {
        status = ask_interval(me, clock, &interval, &qualifier);
    }
    if (status <= STATUS_WARNING && isnan(shift)) {
        status = ask_shift(me, clock, &shift);
    }
    *ticks = never ? (Ticks){.origin = INFINITY}
                   : (Ticks){.origin = me->memory.time + shift, .interval = interval};
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
    return next_tick(ticks) <= me->memory.time + 16.0 * DBL_EPSILON * fabs(me->memory.time);
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
    double interval = 0.0;
    int qualifier;
    const Status status = ask_interval(me, clock, &interval, &qualifier);

    if (qualifier == CHANGED) {
        ticks->origin = me->memory.time + interval;
    } else if (qualifier == NOT_YET_KNOWN || ticked) {
        ticks->origin = INFINITY;
    }
    return status;
}

/* A new interval begins with the tick at which the FMU tells it. */
static Status plan_after_tick(Solver *me, const Clock *clock, Ticks *ticks) {
    const bool may_change = clock->kind == CLOCK_TUNABLE || clock->kind == CLOCK_CHANGING;
    double interval = ticks->interval;
    Status status = STATUS_OK;
    int qualifier = UNCHANGED;

    if (may_change) {
        status = ask_interval(me, clock, &interval, &qualifier);
    }
    if (interval != ticks->interval) {
        ticks->origin = next_tick(ticks);
        ticks->interval = interval;
        ticks->count = 0;
    }
    ticks->count++;
    return status > STATUS_WARNING ? status : check_interval(me, clock, ticks->interval);
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
        next = fmin(next, next_tick(&me->ticks[i]));
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
