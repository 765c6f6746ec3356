/* Jacobian of the state derivatives, and their derivative by time: from the FMU's directional derivatives,
 * or from differences. */

#include <math.h>
#include <string.h>

#include "model_exchange/equations.h"

static const double ROOT = 0x1p-26; /* of the resolution of doubles; for differences */

static double step_for_difference(double value, double nominal) {
    return ROOT * larger(fabs(value), 1e-3 * nominal);
}

/* How fast the rates change from those at x, per change. The arrays do not overlap. */
static void take_slope(size_t n, const double *restrict rates, double change,
                       double *restrict column) {
    const double inverse = 1.0 / change;

    for (size_t i = 0; i < n; i++) {
        column[i] = (column[i] - rates[i]) * inverse;
    }
}

/* The derivatives of the rates by one state, from the FMU or from a difference. Between two calls
 * the trial is x. */
static Status differentiate_by(Solver *me, size_t state, double *column) {
    const Solving *s = me->solving;
    const double value = me->x[state];

    if (s->state_references != NULL) {
        const Status status =
            me->model->differentiate(me->library, me->component, s->rate_references, me->n,
                                     s->state_references[state], column);
        solver_restore_floats(me);
        return status;
    }
    me->trial[state] = value + step_for_difference(value, me->nominals[state]);
    const double change = me->trial[state] - value; /* as rounded */
    const Status status = solver_rates(me, me->memory.time, me->trial, column);
    me->trial[state] = value;
    take_slope(me->n, me->rates, change, column);
    return status;
}

static Status differentiate_by_states(Solver *me) {
    const bool asks = me->solving->state_references != NULL;
    Status status = asks ? solver_place(me, me->memory.time, me->x) : STATUS_OK;

    memcpy(me->trial, me->x, me->n * sizeof *me->trial);
    for (size_t j = 0; j < me->n && good(status); j++) {
        status = differentiate_by(me, j, me->found);
        for (size_t i = 0; i < me->n; i++) {
            me->jacobian[i * me->n + j] = me->found[i];
        }
    }
    me->has_jacobian = good(status);
    return status;
}

static Status differentiate_by_time(Solver *me, double step) {
    const double time = me->memory.time;
    const double later = time + larger(1e-4 * step, ROOT * fabs(time));
    const Status status = solver_rates(me, later, me->x, me->slope);

    take_slope(me->n, me->rates, later - time, me->slope);
    return status;
}

Status solver_differentiate(Solver *me, double step) {
    const Status status = me->has_jacobian ? STATUS_OK : differentiate_by_states(me);

    return good(status) ? differentiate_by_time(me, step) : status;
}
