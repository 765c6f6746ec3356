/* What solvers ask FMUs for. The floating-point environment is restored before anything is computed. */

#include <math.h>
#include <stdarg.h>
#include <stdio.h>

#include "log.h"
#include "solver.h"

/* Messages of the solver itself look like the FMU's. */
Status solver_fail(const Solver *me, const char *format, ...) {
    char text[200];
    va_list values;

    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    log_message_fmi3((void *)(uintptr_t)me->environment, STATUS_ERROR, "solver", text);
    return STATUS_ERROR;
}

void solver_restore_floats(const Solver *me) {
    floats_restore_if_seen(me->floats);
}

/* The FMU keeps its time until another one is set. */
static inline Status set_time(Solver *me, double time) {
    if (time == me->fmu_time) {
        return STATUS_OK;
    }
    const Status status = sane(me->equations->set_time(me->component, time));
    me->fmu_time = good(status) ? time : NAN;
    return status;
}

/* The caller restores the environment: mostly another call of the FMU follows. */
static inline Status move(Solver *me, double time, const double *x) {
    const Status status = set_time(me, time);

    me->is_there = false;
    return good(status) && me->n > 0
               ? sane(me->equations->set_states(me->component, x, me->n))
               : status;
}

Status solver_place(Solver *me, double time, const double *x) {
    const Status status = move(me, time, x);

    solver_restore_floats(me);
    return status;
}

Status solver_indicators(Solver *me, double *z) {
    const size_t count = me->solving->indicators;

    if (count == 0) {
        return STATUS_OK;
    }
    const Status status = sane(me->equations->get_indicators(me->component, z, count));
    solver_restore_floats(me);
    return status;
}

Status solver_rates_here(Solver *me, double *rates) {
    const Status status =
        me->n == 0 ? STATUS_OK : sane(me->equations->get_rates(me->component, rates, me->n));

    solver_restore_floats(me);
    return status;
}

Status solver_rates(Solver *me, double time, const double *x, double *rates) {
    const Status status = move(me, time, x);

    if (!good(status)) {
        solver_restore_floats(me);
        return status;
    }
    return solver_rates_here(me, rates);
}
