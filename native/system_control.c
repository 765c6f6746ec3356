/* Steps of a system whose sizes follow from an estimate of the error.
 *
 * The error of the coupling is what comes from constant inputs within a step. Each step is done
 * twice: at once, and again from a saved state as two of half the size, whose results stay. Both
 * masters are of order 1, so that the difference is about the error of the two small steps. */

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "system.h"

static const double SAFETY = 0.9, SHRINK = 0.2, GROWTH = 2.0;
static const double ROUNDING = 1e-9; /* what counts as the same step size */
static const double RESOLUTION = 16.0 * DBL_EPSILON; /* of times */
static const double PARTS = 1024.0;  /* the most steps in one of the system, unless told otherwise */

/* A step, and what came of it. */
typedef struct {
    Composite *me;
    double time, size;
    double ratio; /* of the error to the tolerance; not finite if there is no estimate */
} Attempt;

static double *statistics(const Composite *me) {
    return me->outputs + me->system->first_statistic;
}

static bool goes_on(Status status) {
    return status <= STATUS_WARNING;
}

static Status step_once(const Attempt *a, double time, double size) {
    return system_step_once(a->me, time, size, false);
}

static void copy_sources(const Composite *me, double *values) {
    const StepControl *control = &me->system->control;

    for (size_t i = 0; i < control->count; i++) {
        values[i] = me->outputs[control->sources[i]];
    }
}

/* What the master tells goes on although the parts go back. */
static Status go_back(Composite *me) {
    double *kept = me->coarse + me->system->control.count;
    const size_t size = (ERROR_OF_FIRST + me->system->control.count) * sizeof(double);

    memcpy(kept, statistics(me), size);
    const Status status = system_set_state(NULL, me, me->beginning);
    memcpy(statistics(me), kept, size);
    return status;
}

/* The values after the large step become the differences. */
static double compare(const Composite *me) {
    const StepControl *control = &me->system->control;
    double worst = 0.0;

    for (size_t i = 0; i < control->count; i++) {
        const double fine = me->outputs[control->sources[i]];
        const double size = fabs(fine) > control->nominals[i] ? fabs(fine) : control->nominals[i];
        const double error = fabs(fine - me->coarse[i]);
        const double ratio = error / (control->tolerance * size);
        me->coarse[i] = error;
        worst = ratio <= worst ? worst : ratio;
        if (!isfinite(ratio)) {
            return INFINITY;
        }
    }
    return worst;
}

/* If a part asks to stop in a small step, the step ends there. */
static Status step_by_halves(Attempt *a) {
    const double half = 0.5 * a->size;
    Status status = step_once(a, a->time, half);

    if (status == STATUS_TERMINATED) {
        memset(a->me->coarse, 0, a->me->system->control.count * sizeof(double));
        a->ratio = 0.0;
        return status;
    }
    if (goes_on(status)) {
        status = step_once(a, a->time + half, half);
    }
    if (goes_on(status) || status == STATUS_TERMINATED) {
        a->ratio = compare(a->me);
    }
    return status;
}

static bool can_be_repeated(Status status) {
    return status == STATUS_DISCARD || status == STATUS_NOT_FINITE;
}

/* Begins at a saved state, and ends after the small steps. */
static Status attempt(Attempt *a) {
    Composite *me = a->me;
    Status status = step_once(a, a->time, a->size);

    a->ratio = INFINITY;
    if (can_be_repeated(status)) {
        return status;
    }
    if (goes_on(status) || status == STATUS_TERMINATED) {
        copy_sources(me, me->coarse);
        status = go_back(me);
    }
    return goes_on(status) ? step_by_halves(a) : status;
}

static double factor_of(double ratio) {
    const double factor = ratio > 0.0 ? SAFETY / sqrt(ratio) : GROWTH;
    return factor > GROWTH ? GROWTH : factor >= SHRINK ? factor : SHRINK;
}

static void count_step(Composite *me, const Attempt *a) {
    double *values = statistics(me), *errors = values + ERROR_OF_FIRST;

    values[COUNT_OF_STEPS] += 2.0;
    values[WORST_ERROR] = values[WORST_ERROR] >= a->ratio ? values[WORST_ERROR] : a->ratio;
    for (size_t i = 0; i < me->system->control.count; i++) {
        errors[i] = errors[i] >= me->coarse[i] ? errors[i] : me->coarse[i];
    }
}

/* The rest of a step in equal parts of at most this size. */
static double divided(double rest, double size) {
    const double parts = ceil(rest / size - ROUNDING);
    return parts > 1.0 ? rest / parts : rest;
}

static double clamped(double size, double smallest, double largest) {
    const double least = size > smallest ? size : smallest;
    return least < largest ? least : largest;
}

static void begin(Composite *me, double step) {
    double *values = statistics(me);

    values[WORST_ERROR] = 0.0;
    memset(values + ERROR_OF_FIRST, 0, me->system->control.count * sizeof(double));
    if (!(values[NEXT_SIZE] > 0.0)) {
        values[NEXT_SIZE] = step;
    }
}

/* Does one step of at most the next size, as often as it takes. Returns its size. */
static Status advance(Composite *me, double time, double rest, double smallest, double *size) {
    Status status = system_get_state(NULL, me, &me->beginning);

    *size = divided(rest, statistics(me)[NEXT_SIZE]);
    while (goes_on(status)) {
        Attempt a = {me, time, *size, INFINITY};
        const bool is_last = *size <= smallest * (1.0 + ROUNDING);
        status = attempt(&a);
        const bool good = goes_on(status) || status == STATUS_TERMINATED;
        if (good && (a.ratio <= 1.0 || is_last || status == STATUS_TERMINATED)) {
            count_step(me, &a);
            statistics(me)[NEXT_SIZE] = *size * factor_of(a.ratio);
            return status;
        }
        if (!good && (is_last || !can_be_repeated(status))) {
            return status;
        }
        statistics(me)[COUNT_OF_REJECTIONS] += 1.0;
        status = go_back(me);
        *size = divided(rest, clamped(*size * factor_of(a.ratio), smallest, rest));
    }
    return status;
}

/* A step that the time does not show would be repeated for ever. */
static double smallest_step(const Composite *me, double time, double step) {
    const double told = me->system->control.smallest;
    const double smallest = told > 0.0 && told < step ? told : step / PARTS;
    const double shown = RESOLUTION * (fabs(time) + step);

    return smallest > shown ? smallest : shown;
}

Status system_step_controlled(Composite *me, double time, double step) {
    const double smallest = smallest_step(me, time, step);
    double done = 0.0, size = 0.0;
    Status status = STATUS_OK;

    begin(me, step);
    while (goes_on(status) && done < step) {
        const double rest = step - done;
        status = advance(me, time + done, rest, smallest, &size);
        done = size < rest ? done + size : step;
        statistics(me)[NEXT_SIZE] = clamped(statistics(me)[NEXT_SIZE], smallest, step);
    }
    return status;
}

void control_forget(Composite *me) {
    if (me->beginning != NULL) {
        system_free_state(NULL, me, &me->beginning);
    }
}
