/* Integration of the equations of an instance, with its events. */

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model_exchange/equations.h"
#include "model_exchange/interruption.h"

enum {
    MOST_UPDATES = 1000,  /* of the discrete states in one event */
    MOST_EVENTS = 100000, /* in one communication step */
    MOST_TRIES = 1000000, /* of steps in one communication step */
    MOST_ERRORS = 10,     /* of the FMU in tries of one step */
    MANY_TRIES = 40,      /* from which stiffness is looked for */
    EVERY_TRY = 2,        /* in each so many of them */
    STIFF_TRIES = 15,     /* that tell stiffness, */
    CALM_TRIES = 6        /* unless so many others are between them */
};

static const double GROWTH = 6.0, SHRINKAGE = 0.2, HALF = 0.5, SAFETY = 0.9;
static const char ADVICE[] = "; for stiff equations, set solver = \"rosenbrock\"";
static const double STIFF = 3.25; /* step times eigenvalue where explicit methods become unstable */
static const double SMALL = 0.01;   /* part of a nominal value that errors are compared with */
static const double FIRST = 0.01;   /* part of its value that a state changes in the first step */
static const double ROUNDED = 1.0 + 1e-6; /* a step may be longer than allowed by a rounding */

/* Memory */

static double *take(double **place, size_t count) {
    double *start = *place;
    *place += count;
    return start;
}

static void share_out(Solver *me, double *memory) {
    const Solving *s = me->solving;
    const size_t square = s->method->needs_jacobian ? me->n * me->n : 0;

    me->x = take(&memory, me->n);
    me->rates = take(&memory, me->n);
    me->next = take(&memory, me->n);
    me->nominals = take(&memory, me->n);
    me->trial = take(&memory, me->n);
    me->slope = take(&memory, me->n);
    me->stages = take(&memory, me->n * s->method->stages);
    me->jacobian = take(&memory, square);
    me->matrix = take(&memory, square);
    me->found = take(&memory, me->n);
    me->z = take(&memory, s->indicators);
    me->next_z = take(&memory, s->indicators);
    me->low_z = take(&memory, s->indicators);
    me->found_z = take(&memory, s->indicators);
}

size_t solver_size_of_ticks(const Solver *me) {
    return me->solving->number_of_clocks * sizeof(Ticks);
}

bool solver_open(Solver *me) {
    const Solving *s = me->solving;
    const size_t rows = 7 + s->method->stages + (s->method->needs_jacobian ? 2 * s->states : 0);

    me->n = s->states;
    double *memory = calloc(me->n * rows + 4 * s->indicators + 1, sizeof *memory);
    me->order = calloc(me->n + 1, sizeof *me->order);
    me->ticks = calloc(s->number_of_clocks + 1, sizeof *me->ticks);
    me->active = calloc(s->number_of_clocks + 1, sizeof *me->active);
    me->arrays = memory;
    if (memory == NULL || me->order == NULL || me->ticks == NULL || me->active == NULL) {
        solver_close(me);
        return false;
    }
    share_out(me, memory);
    return true;
}

void solver_close(Solver *me) {
    free(me->arrays);
    free(me->order);
    free(me->ticks);
    free(me->active);
}

/* Reads the states and their nominal values, which an event may have changed. */
static Status read_states(Solver *me) {
    Status status = STATUS_OK;

    if (me->n > 0) {
        status = sane(me->equations->get_states(me->component, me->x, me->n));
    }
    if (good(status) && me->n > 0 && me->solving->method->order > 0.0) {
        status = sane(me->equations->get_nominals(me->component, me->nominals, me->n));
    }
    solver_restore_floats(me);
    for (size_t i = 0; i < me->n; i++) {
        const double nominal = fabs(me->nominals[i]);
        me->nominals[i] = nominal > 0.0 && nominal <= DBL_MAX ? nominal : 1.0;
    }
    me->stale = me->is_there = false;
    me->fmu_time = NAN;
    me->knows_rates = me->knows_indicators = me->has_jacobian = false;
    return status;
}

/* Finds out what is not yet known of the equations at the current time and states. */
static Status know(Solver *me) {
    Status status = STATUS_OK;

    if (!me->knows_rates && me->is_there) {
        status = solver_rates_here(me, me->rates);
    } else if (!me->knows_rates) {
        status = solver_rates(me, me->memory.time, me->x, me->rates);
    }
    if (good(status) && !me->knows_indicators) {
        status = solver_indicators_here(me, me->z);
    }
    me->knows_rates = me->knows_indicators = good(status);
    return status;
}

/* Events */

static Status enter(Solver *me, int (*mode)(void *component)) {
    const Status status = mode == NULL ? STATUS_OK : sane(mode(me->component));

    solver_restore_floats(me);
    return status;
}

Status solver_enter_events(Solver *me) {
    const Status status = enter(me, me->equations->enter_events);

    me->memory.mode = IN_EVENTS;
    return status;
}

static Status update(Solver *me, Events *events) {
    const double next = me->memory.next_event;

    *events = (Events){.has_next = next > me->memory.time && next < INFINITY, .next = next};
    const Status status = me->model->update(me->library, me->component, events);

    solver_restore_floats(me);
    return status;
}

Status solver_settle(Solver *me) {
    Events events = {.again = true};
    Status status = clocks_activate(me);

    for (int i = 0; events.again && !events.terminate && good(status); i++) {
        if (i == MOST_UPDATES) {
            return solver_fail(me, "the discrete states at t = %g s do not settle in %d updates",
                        me->memory.time, MOST_UPDATES);
        }
        status = clocks_watch(me);
        if (good(status)) {
            status = update(me, &events);
        }
    }
    me->memory.terminated |= events.terminate;
    if (!good(status) || events.terminate) {
        return status;
    }
    status = clocks_plan(me);
    if (!good(status)) {
        return status;
    }
    const double next = events.has_next && !isnan(events.next) ? events.next : INFINITY;
    me->memory.next_event = smaller(next, clocks_next(me));
    status = enter(me, me->equations->enter_continuous);
    me->memory.mode = IN_CONTINUOUS_TIME;
    return good(status) ? read_states(me) : status;
}

static Status handle_event(Solver *me) {
    if (++me->events > MOST_EVENTS) {
        return solver_fail(me, "the model has more than %d events in a step, the last at t = %.17g s",
                    MOST_EVENTS, me->memory.time);
    }
    const Status status = solver_enter_events(me);
    return good(status) ? solver_settle(me) : status;
}

/* Steps */

double solver_norm(const Solver *me, const double *errors) {
    const double tolerance = me->solving->tolerance;
    double sum = 0.0;

    for (size_t i = 0; i < me->n; i++) {
        const double size = larger(fabs(me->x[i]), fabs(me->next[i]));
        const double part = errors[i] / (tolerance * (size + SMALL * me->nominals[i]));
        sum += part * part;
    }
    return me->n == 0 ? 0.0 : sqrt(sum / (double)me->n);
}

/* Two times that are this close are the same. */
static double resolution(const Solver *me, double until) {
    return 16.0 * DBL_EPSILON * larger(fabs(me->memory.time), fabs(until));
}

/* In the first step each state changes by a small part of its value. */
static double first_step(const Solver *me) {
    double sum = 0.0;

    for (size_t i = 0; i < me->n; i++) {
        const double part = me->rates[i] / (fabs(me->x[i]) + SMALL * me->nominals[i]);
        sum += part * part;
    }
    return sum > 0.0 ? FIRST / sqrt(sum / (double)me->n) : INFINITY;
}

/* Divides what remains so that no very short step is left at the end. */
static double size_of_step(Solver *me, double remaining) {
    const double shortest = resolution(me, me->memory.time + remaining);
    const double most = me->solving->max_step;

    if (me->solving->method->order == 0.0) {
        return remaining / larger(1.0, ceil(remaining / (ROUNDED * most)));
    }
    if (!(me->memory.step > 0.0)) {
        me->memory.step = first_step(me);
    }
    const double size = larger(smaller(me->memory.step, most), shortest);
    if (remaining <= smaller(1.1 * size, ROUNDED * most)) {
        return remaining;
    }
    return remaining < 2.0 * size ? 0.5 * remaining : size;
}

static double factor_after(const Solver *me, double error) {
    const double factor = SAFETY * pow(error, -1.0 / me->solving->method->order);
    return error > 0.0 ? smaller(GROWTH, larger(SHRINKAGE, factor)) : GROWTH;
}

/* A step that was shorter than proposed tells little of how long the next one may be. */
static void accept(Solver *me, double size, double error) {
    const double proposed = size * factor_after(me, error);
    me->memory.step = size < me->memory.step ? larger(me->memory.step, proposed) : proposed;
}

/* Counts tries, which may be many without end: the equations may be stiff, or not smooth. */
static Status count_try(Solver *me) {
    const Method *method = me->solving->method;

    if (solver_is_interrupted(me)) {
        return solver_fail(me, "the step was interrupted at t = %.17g s", me->memory.time);
    }
    if (++me->tries <= MOST_TRIES) {
        return STATUS_OK;
    }
    return solver_fail(me,
                       "%s needs more than %d steps in a communication step, the last at t = %.17g s%s",
                       method == &by_fmu ? "the FMU" : method->name, MOST_TRIES, me->memory.time,
                       method->stiffness != NULL ? ADVICE : "");
}

/* Warns once that the equations are stiff. Looks at every EVERY_TRY-th try after MANY_TRIES. */
static void watch_stiffness(Solver *me, double end) {
    const Method *method = me->solving->method;

    if (method->stiffness == NULL || me->tries < MANY_TRIES || me->tries % EVERY_TRY > 0) {
        return;
    }
    const bool stiff = method->stiffness(me, end) > STIFF;
    me->calm = stiff ? 0 : me->calm + 1;
    me->stiff = stiff ? me->stiff + 1 : me->calm == CALM_TRIES ? 0 : me->stiff;
    if (me->stiff == STIFF_TRIES && is_first_to_find_stiff()) {
        solver_warn(me,
                    "the equations are stiff at t = %.3g s: %s has taken %zu steps in this communication "
                    "step; solver = \"rosenbrock\" takes fewer",
                    me->memory.time, method->name, me->tries);
    }
}

/* What the FMU may refuse in a try: a shorter one may not ask for it. */
static bool may_retry(Status status, int errors) {
    return status == STATUS_DISCARD || (status == STATUS_ERROR && errors < MOST_ERRORS);
}

static double shrinkage(const Solver *me, Status status, double error) {
    if (status == STATUS_ERROR) {
        return HALF;
    }
    const bool finite = good(status) && error <= DBL_MAX;
    return finite ? smaller(SAFETY, factor_after(me, error)) : SHRINKAGE;
}

/* Tries shorter and shorter steps until the error is within the tolerance. Only a method without
 * an estimate passes on that the FMU discards a call, or fails in it, at once. */
static Status take_step(Solver *me, double until, double *end) {
    const Method *method = me->solving->method;
    const double remaining = until - me->memory.time;
    double size = size_of_step(me, remaining), error;

    for (int errors = 0;;) {
        *end = size >= remaining ? until : me->memory.time + size;
        Status status = count_try(me);
        if (!good(status)) {
            return status;
        }
        status = method->step(me, *end, &error);
        if (method->order == 0.0 || (!good(status) && !may_retry(status, errors))) {
            return status;
        }
        if (good(status) && error <= 1.0) {
            watch_stiffness(me, *end);
            accept(me, size, error);
            return status;
        }
        errors += status == STATUS_ERROR;
        me->memory.step = size *= shrinkage(me, status, error);
        if (size < resolution(me, until)) {
            return solver_fail(me, "the solver %s needs steps below %.3g s at t = %.17g s%s",
                               method->name, size, me->memory.time,
                               good(status) ? "" : ", since the FMU fails in longer ones");
        }
    }
}

static void exchange_arrays(double **a, double **b) {
    double *kept = *a;
    *a = *b;
    *b = kept;
}

/* Makes the end of a step the current time. The FMU is there already. */
static void move_on(Solver *me, double end, bool interrupted) {
    const Method *method = me->solving->method;

    me->memory.time = end;
    exchange_arrays(&me->x, &me->next);
    exchange_arrays(&me->z, &me->next_z);
    me->knows_rates = method->last > 0 && !interrupted;
    me->is_there = me->knows_indicators = !interrupted;
    me->has_jacobian = false;
    if (me->knows_rates) {
        memcpy(me->rates, me->stages + method->last * me->n, me->n * sizeof(double));
    }
}

static Status complete(Solver *me, bool *event) {
    bool terminate = false;
    Status status = STATUS_OK;

    if (me->solving->completes) {
        status = me->model->complete(me->library, me->component, event, &terminate);
        solver_restore_floats(me);
    }
    me->memory.terminated |= terminate;
    return status;
}

/* Takes a very short step if an indicator is 0. As the states move, it may become positive at once,
 * and the sign after a whole step would not tell: a ball that bounces may be down again. */
static Status leave_zero(Solver *me, double until, double *end, bool *event) {
    bool any = false;

    for (size_t i = 0; i < me->solving->indicators; i++) {
        any |= me->z[i] == 0.0;
    }
    if (!any) {
        return STATUS_OK;
    }
    *end = me->memory.time + resolution(me, until);
    for (size_t i = 0; i < me->n; i++) {
        me->next[i] = me->x[i] + (*end - me->memory.time) * me->rates[i];
    }
    const Status status = solver_indicators(me, *end, me->next, me->next_z);
    *event = good(status) && solver_crosses(me, me->z, me->next_z);
    return status;
}

/* Takes a step as long as the method can, up to this time or the first event. */
static Status take_whole_step(Solver *me, double until, double *end, bool *event) {
    Status status = take_step(me, until, end);

    if (good(status) && me->solving->method->last == 0) {
        status = solver_indicators(me, *end, me->next, me->next_z);
    } else if (good(status)) { /* the last stage was there */
        status = solver_indicators_here(me, me->next_z);
    }
    *event = good(status) && solver_crosses(me, me->z, me->next_z);
    return *event ? solver_locate(me, end) : status;
}

/* Lets the FMU step to this time, or until it wants an event or returns early. */
static Status step_by_fmu(Solver *me, double until) {
    const double time = me->memory.time;
    double reached = until;
    bool event = false, terminate = false;
    Status status = count_try(me);
    if (!good(status)) {
        return status;
    }
    status = me->model->step(me->library, me->component, time, until - time, &reached,
                                          &event, &terminate);

    solver_restore_floats(me);
    if (!good(status)) {
        return status;
    }
    if (!(reached > time || event || terminate) || reached > until + resolution(me, until)) {
        return solver_fail(me, "the FMU returned from a step from t = %.17g s to %.17g s at %.17g s",
                           time, until, reached);
    }
    me->memory.time = smaller(larger(time, reached), until);
    me->memory.terminated |= terminate;
    return event && !terminate ? handle_event(me) : status;
}

/* Takes one step, to this time or the first event. */
static Status step_to(Solver *me, double until) {
    bool state_event = false, step_event = false;
    double end = until;
    Status status = know(me);

    if (good(status)) {
        status = leave_zero(me, until, &end, &state_event);
    }
    if (good(status) && !state_event) {
        status = take_whole_step(me, until, &end, &state_event);
    }
    if (!good(status)) {
        return status;
    }
    move_on(me, end, state_event);
    status = complete(me, &step_event);
    const bool event = (state_event || step_event) && !me->memory.terminated;
    return event && good(status) ? handle_event(me) : status;
}

/* Time events */

static bool is_due(const Solver *me, double until) {
    return me->memory.next_event <= me->memory.time + resolution(me, until);
}

static Status handle_time_event(Solver *me) {
    me->memory.time = larger(me->memory.time, me->memory.next_event);
    const bool is_there = me->model->step != NULL; /* the FMU itself keeps its time */
    const Status status = is_there ? STATUS_OK : solver_place(me, me->memory.time, me->x);
    return good(status) ? handle_event(me) : status;
}

Status solver_advance(Solver *me, double until) {
    Memory *memory = &me->memory;
    Status status = STATUS_OK;

    me->events = me->tries = me->stiff = me->calm = 0;
    if (memory->mode == IN_EVENTS && !memory->terminated) {
        status = solver_settle(me);
    } else if (me->stale) {
        status = read_states(me);
    }
    while (good(status) && !memory->terminated) {
        if (is_due(me, until)) {
            status = handle_time_event(me);
        } else if (memory->time < until - resolution(me, until)) {
            const double end = smaller(until, memory->next_event);
            status = me->model->step != NULL ? step_by_fmu(me, end) : step_to(me, end);
        } else {
            memory->time = larger(memory->time, until);
            break;
        }
    }
    return good(status) && memory->terminated ? STATUS_TERMINATED : status;
}
