/* The classical Runge-Kutta method of order 4. */

#include "model_exchange/equations.h"

/* Its arrays do not overlap, as those of the next function. That helps the compiler. */
static void move(size_t n, const double *restrict x, double step, const double *restrict rates,
                 double *restrict moved) {
    for (size_t i = 0; i < n; i++) {
        moved[i] = x[i] + step * rates[i];
    }
}

static void combine(size_t n, const double *restrict x, double step, const double *restrict k1,
                    const double *restrict others, double *restrict after) {
    const double *k2 = others, *k3 = others + n, *k4 = others + 2 * n, sixth = step / 6.0;

    for (size_t i = 0; i < n; i++) {
        after[i] = x[i] + sixth * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
    }
}

static Status stages(Solver *me, double step) {
    const double time = me->memory.time, middle = time + 0.5 * step;
    double *k2 = me->stages, *k3 = k2 + me->n, *k4 = k3 + me->n;

    move(me->n, me->x, 0.5 * step, me->rates, me->trial);
    Status status = solver_rates(me, middle, me->trial, k2);
    if (status <= STATUS_WARNING) {
        move(me->n, me->x, 0.5 * step, k2, me->trial);
        status = solver_rates(me, middle, me->trial, k3);
    }
    if (status <= STATUS_WARNING) {
        move(me->n, me->x, step, k3, me->trial);
        status = solver_rates(me, time + step, me->trial, k4);
    }
    return status;
}

/* A shorter step gives the state in between: it is as exact as the step itself. */
static Status between(Solver *me, double end, double fraction, double *x) {
    const double step = (end - me->memory.time) * fraction;
    const Status status = stages(me, step);

    if (status <= STATUS_WARNING) {
        combine(me->n, me->x, step, me->rates, me->stages, x);
    }
    return status;
}

static Status step(Solver *me, double end, double *error) {
    *error = 0.0;
    return between(me, end, 1.0, me->next);
}

const Method rk4 = {.name = "rk4", .stages = 3, .step = step, .between = between};
