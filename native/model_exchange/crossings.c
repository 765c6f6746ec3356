/* State events: where in a step an event indicator crosses zero. */

#include <float.h>
#include <math.h>
#include <string.h>

#include "model_exchange/equations.h"

enum { MOST_GUESSES = 200 }; /* of the time of one event */

static const double SHARP = 1e-3; /* part of the tolerance to which events are located */

Status solver_check_indicators(const Solver *me, const double *z) {
    for (size_t i = 0; i < me->solving->indicators; i++) {
        if (isnan(z[i])) {
            solver_restore_floats(me);
            return solver_fail(me, "event indicator %zu of %zu is NaN after t = %.17g s", i + 1,
                               me->solving->indicators, me->memory.time);
        }
    }
    return STATUS_OK;
}

/* An interval of fractions of a step: no indicator has crossed zero at low, one has at high. */
typedef struct {
    double low, high;
    double low_weight, high_weight; /* halved while an end stays where it is (Illinois method) */
} Bracket;

/* The fraction at which straight lines between the ends cross first. */
static double first_crossing(const Solver *me, const Bracket *b) {
    double first = 1.0;

    for (size_t i = 0; i < me->solving->indicators; i++) {
        const double low = b->low_weight * me->low_z[i], high = b->high_weight * me->next_z[i];
        if ((low > 0.0) != (high > 0.0) && low / (low - high) < first) {
            first = low / (low - high);
        }
    }
    return b->low + first * (b->high - b->low);
}

/* Keeps a guess so far from both ends that one of them moves by at least this much. Each fourth
 * guess halves the interval. */
static double next_guess(const Solver *me, const Bracket *b, int guesses, double least) {
    const double middle = 0.5 * (b->low + b->high);
    const double guess = guesses % 4 == 3 ? middle : first_crossing(me, b);

    if (!(guess > b->low + least)) {
        return fmin(b->low + least, middle);
    }
    return guess < b->high - least ? guess : fmax(b->high - least, middle);
}

/* Goes to a fraction of the step, and reads the indicators there. */
static Status go_to(Solver *me, double end, double fraction) {
    const double time = me->memory.time;
    const Status status = me->solving->method->between(me, end, fraction, me->found);

    return good(status)
               ? solver_indicators(me, time + fraction * (end - time), me->found, me->found_z)
               : status;
}

static void narrow(Solver *me, Bracket *b, double guess) {
    const size_t size = me->solving->indicators * sizeof(double);

    if (solver_crosses(me, me->z, me->found_z)) {
        *b = (Bracket){b->low, guess, 0.5 * b->low_weight, 1.0};
        memcpy(me->next_z, me->found_z, size);
    } else {
        *b = (Bracket){guess, b->high, 1.0, 0.5 * b->high_weight};
        memcpy(me->low_z, me->found_z, size);
    }
}

Status solver_locate(Solver *me, double *end) {
    const double time = me->memory.time, step = *end - time;
    const double width = fmax(SHARP * me->solving->tolerance,
                              4.0 * DBL_EPSILON * fmax(fabs(time), fabs(*end)) / step);
    Bracket b = {0.0, 1.0, 1.0, 1.0};
    Status status = STATUS_OK;

    memcpy(me->low_z, me->z, me->solving->indicators * sizeof(double));
    for (int i = 0; b.high - b.low > width && i < MOST_GUESSES && good(status); i++) {
        const double guess = next_guess(me, &b, i, 0.5 * width);
        status = go_to(me, *end, guess);
        narrow(me, &b, guess);
    }
    if (b.high == 1.0 || !good(status)) {
        return good(status) ? solver_place(me, *end, me->next) : status;
    }
    status = go_to(me, *end, b.high);
    memcpy(me->next, me->found, me->n * sizeof(double));
    *end = time + b.high * step;
    return status;
}
