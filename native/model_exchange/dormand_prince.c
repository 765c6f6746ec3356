/* The method of Dormand and Prince of order 5 with an estimate of order 4 and dense output: Hairer,
 * Norsett, Wanner, Solving Ordinary Differential Equations I, section II.5 and II.6. */

#include "model_exchange/stages.h"

enum { STAGES = 7 };

static const double nodes[STAGES] = {0.0, 1.0 / 5, 3.0 / 10, 4.0 / 5, 8.0 / 9, 1.0, 1.0};

/* The last row also gives the result, so that the last stage is the rates at the end. */
static const double weights[STAGES][STAGES] = {
    {0.0},
    {1.0 / 5},
    {3.0 / 40, 9.0 / 40},
    {44.0 / 45, -56.0 / 15, 32.0 / 9},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
    {35.0 / 384, 0.0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84},
};

static const double errors[STAGES] = {71.0 / 57600,      0.0,        -71.0 / 16695, 71.0 / 1920,
                                      -17253.0 / 339200, 22.0 / 525, -1.0 / 40};

static const double dense[STAGES] = {-12715105075.0 / 11282082432,  0.0,
                                     87487479700.0 / 32700410799,   -10690763975.0 / 1880347072,
                                     701980252875.0 / 199316789632, -1453857185.0 / 822651844,
                                     69997945.0 / 29380423};

/* A stage with the states where it is evaluated, which after the last stage are the result. */
static ALWAYS_INLINE Status do_stage(Solver *me, const int s, double end) {
    const double time = me->memory.time, size = end - time;

    move_by_sums(me->n, me->x, size, weights[s], s, me->stages, me->next);
    return solver_rates(me, nodes[s] == 1.0 ? end : time + nodes[s] * size, me->next,
                        me->stages + (size_t)s * me->n);
}

/* Written out, so that the compiler knows the number of each stage. */
static Status do_stages(Solver *me, double end) {
    Status status = do_stage(me, 1, end);

    status = status <= STATUS_WARNING ? do_stage(me, 2, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, 3, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, 4, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, 5, end) : status;
    return status <= STATUS_WARNING ? do_stage(me, 6, end) : status;
}

static Status step(Solver *me, double end, double *error) {
    const double size = end - me->memory.time;

    for (size_t i = 0; i < me->n; i++) {
        me->stages[i] = me->rates[i];
    }
    const Status status = do_stages(me, end);
    for (size_t i = 0; i < me->n; i++) {
        me->trial[i] = size * weighted_sum(errors, STAGES, me->stages + i, me->n);
    }
    *error = solver_norm(me, me->trial);
    return status;
}

/* The product of the step and the largest eigenvalue, as Hairer and Wanner estimate it from the last two
 * stages, which are both at the end: Solving Ordinary Differential Equations II, section IV.2. */
static double stiffness(Solver *me, double end) {
    const double size = end - me->memory.time;
    const double *before = me->stages + (STAGES - 2) * me->n, *last = before + me->n;

    for (size_t i = 0; i < me->n; i++) {
        const double sum = weighted_sum(weights[STAGES - 2], STAGES - 2, me->stages + i, me->n);
        me->trial[i] = size * (last[i] - before[i]);
        me->found[i] = me->next[i] - (me->x[i] + size * sum);
    }
    const double distance = solver_norm(me, me->found);
    return distance > 0.0 ? solver_norm(me, me->trial) / distance : 0.0;
}

static Status between(Solver *me, double end, double fraction, double *x) {
    const double size = end - me->memory.time, rest = 1.0 - fraction;
    const double *last = me->stages + (STAGES - 1) * me->n;

    for (size_t i = 0; i < me->n; i++) {
        const double change = me->next[i] - me->x[i];
        const double first = size * me->stages[i] - change;
        const double second = change - size * last[i] - first;
        const double third = size * weighted_sum(dense, STAGES, me->stages + i, me->n);
        x[i] = me->x[i] +
               fraction * (change + rest * (first + fraction * (second + rest * third)));
    }
    return STATUS_OK;
}

const Method dormand_prince = {.name = "dormand_prince",
                               .stages = STAGES,
                               .order = 5.0,
                               .last = STAGES - 1,
                               .step = step,
                               .stiffness = stiffness,
                               .between = between};
