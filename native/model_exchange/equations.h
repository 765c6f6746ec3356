/* What solvers ask FMUs for. The floating-point environment is restored before anything is computed:
 * once where one call of the FMU follows another. */

#ifndef FMUGYM_EQUATIONS_H
#define FMUGYM_EQUATIONS_H

#include <math.h>

#include "model_exchange/solver.h"

static inline Status equations_restored(const Solver *me, Status status) {
    solver_restore_floats(me);
    return status;
}

/* The FMU keeps its time until another one is set. */
static inline Status equations_set_time(Solver *me, double time) {
    if (time == me->fmu_time) {
        return STATUS_OK;
    }
    const Status status = sane(me->equations->set_time(me->component, time));
    me->fmu_time = good(status) ? time : NAN;
    return status;
}

static inline Status equations_move(Solver *me, double time, const double *x) {
    const Status status = equations_set_time(me, time);

    me->is_there = false;
    return good(status) && me->n > 0
               ? sane(me->equations->set_states(me->component, x, me->n))
               : status;
}

static inline Status equations_rates(Solver *me, double *rates) {
    return me->n == 0 ? STATUS_OK : sane(me->equations->get_rates(me->component, rates, me->n));
}

static inline Status equations_indicators(Solver *me, double *z) {
    const size_t count = me->solving->indicators;
    const Status status =
        count == 0 ? STATUS_OK : sane(me->equations->get_indicators(me->component, z, count));
    return good(status) ? solver_check_indicators(me, z) : status;
}

/* Moves the FMU to a time and state. */
static inline Status solver_place(Solver *me, double time, const double *x) {
    return equations_restored(me, equations_move(me, time, x));
}

/* The rates where the FMU is, and at a time and state. */
static inline Status solver_rates_here(Solver *me, double *rates) {
    return equations_restored(me, equations_rates(me, rates));
}
static inline Status solver_rates(Solver *me, double time, const double *x, double *rates) {
    const Status status = equations_move(me, time, x);
    return equations_restored(me, good(status) ? equations_rates(me, rates) : status);
}

/* The event indicators in the same two places. */
static inline Status solver_indicators_here(Solver *me, double *z) {
    return equations_restored(me, equations_indicators(me, z));
}
static inline Status solver_indicators(Solver *me, double time, const double *x, double *z) {
    const Status status = equations_move(me, time, x);
    return equations_restored(me, good(status) ? equations_indicators(me, z) : status);
}

#endif
