/* The classical Runge-Kutta method of order 4. */

#include "solver.h"

static void move(Solver *me, double step, const double *rates) {
    for (size_t i = 0; i < me->n; i++) {
        me->trial[i] = me->x[i] + step * rates[i];
    }
}

static Status stages(Solver *me, double step) {
    const double time = me->memory.time, middle = time + 0.5 * step;
    double *k2 = me->stages, *k3 = k2 + me->n, *k4 = k3 + me->n;

    move(me, 0.5 * step, me->rates);
    Status status = solver_rates(me, middle, me->trial, k2);
    if (status <= STATUS_WARNING) {
        move(me, 0.5 * step, k2);
        status = solver_rates(me, middle, me->trial, k3);
    }
    if (status <= STATUS_WARNING) {
        move(me, step, k3);
        status = solver_rates(me, time + step, me->trial, k4);
    }
    return status;
}

/* A shorter step gives the state in between: it is as exact as the step itself. */
static Status between(Solver *me, double end, double fraction, double *x) {
    const double step = (end - me->memory.time) * fraction;
    const Status status = stages(me, step);
    const double *k2 = me->stages, *k3 = k2 + me->n, *k4 = k3 + me->n;

    for (size_t i = 0; i < me->n && status <= STATUS_WARNING; i++) {
        const double sum = me->rates[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i];
        x[i] = me->x[i] + step * sum / 6.0;
    }
    return status;
}

static Status step(Solver *me, double end, double *error) {
    *error = 0.0;
    return between(me, end, 1.0, me->next);
}

const Method rk4 = {.name = "rk4", .stages = 3, .step = step, .between = between};
