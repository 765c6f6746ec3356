/* RODAS, a stiffly accurate Rosenbrock method of order 4 with an estimate of order 3 and dense
 * output, for stiff equations: Hairer, Wanner, Solving Ordinary Differential Equations II, section
 * IV.7. The coefficients are those of the transformed form, which needs no product of matrix and
 * vector. */

#include <math.h>
#include <string.h>

#include "stages.h"

enum { STAGES = 6 };

static const double gamma_ = 0.25;
static const double nodes[STAGES] = {0.0, 0.386, 0.21, 0.63, 1.0, 1.0};
static const double slopes[STAGES] = {0.25, -0.1043, 0.1035, -0.03620000000000023, 0.0, 0.0};

/* The last row plus the last stage gives the result; the last stage is the error. */
static const double weights[STAGES][STAGES] = {
    {0.0},
    {1.544},
    {0.9466785280815826, 0.2557011698983284},
    {3.314825187068521, 2.896124015972201, 0.9986419139977817},
    {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950},
    {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0},
};

static const double couplings[STAGES][STAGES] = {
    {0.0},
    {-5.6688},
    {-2.430093356833875, -0.2063599157091915},
    {-0.1073529058151375, -9.594562251023355, -20.47028614809616},
    {7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160},
    {8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136,
     -6.058818238834054},
};

static const double dense[2][STAGES] = {
    {10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823,
     1.025137723295662},
    {-0.6762803392806898, 6.087714651680015, 16.43084320892478, 24.76722511418386,
     -6.594389125716872},
};

/* The row of the largest element in or below the diagonal. */
static size_t pivot_of(const double *matrix, size_t n, size_t column) {
    size_t best = column;

    for (size_t row = column + 1; row < n; row++) {
        if (fabs(matrix[row * n + column]) > fabs(matrix[best * n + column])) {
            best = row;
        }
    }
    return best;
}

static void swap(double *matrix, size_t n, size_t a, size_t b) {
    for (size_t i = 0; i < n && a != b; i++) {
        const double value = matrix[a * n + i];
        matrix[a * n + i] = matrix[b * n + i];
        matrix[b * n + i] = value;
    }
}

/* Factorizes in place, with partial pivoting. The diagonal holds reciprocals, because divisions are
 * slow. A singular matrix gives infinite or undefined results, so that the step is refused. */
static void factorize(double *matrix, size_t n, uint32_t *pivots) {
    for (size_t k = 0; k < n; k++) {
        pivots[k] = (uint32_t)pivot_of(matrix, n, k);
        swap(matrix, n, k, pivots[k]);
        const double reciprocal = matrix[k * n + k] = 1.0 / matrix[k * n + k];
        for (size_t row = k + 1; row < n; row++) {
            const double factor = matrix[row * n + k] * reciprocal;
            matrix[row * n + k] = factor;
            for (size_t i = k + 1; i < n; i++) {
                matrix[row * n + i] -= factor * matrix[k * n + i];
            }
        }
    }
}

static void solve(const double *matrix, size_t n, const uint32_t *pivots, double *restrict b) {
    for (size_t row = 0; row < n; row++) {
        double value = b[pivots[row]];
        b[pivots[row]] = b[row];
        for (size_t i = 0; i < row; i++) {
            value -= matrix[row * n + i] * b[i];
        }
        b[row] = value;
    }
    for (size_t row = n; row-- > 0;) {
        double value = b[row];
        for (size_t i = row + 1; i < n; i++) {
            value -= matrix[row * n + i] * b[i];
        }
        b[row] = value * matrix[row * n + row];
    }
}

static void prepare_matrix(Solver *me, double size) {
    const double diagonal = 1.0 / (size * gamma_);

    for (size_t i = 0; i < me->n * me->n; i++) {
        me->matrix[i] = -me->jacobian[i];
    }
    for (size_t i = 0; i < me->n; i++) {
        me->matrix[i * me->n + i] += diagonal;
    }
    factorize(me->matrix, me->n, me->pivots);
}

/* Adds what the rates of a stage lack. The arrays do not overlap. */
static ALWAYS_INLINE void couple(size_t n, const int s, double size,
                                 const double *restrict slope, const double *restrict stages,
                                 double *restrict stage) {
    const double inverse = 1.0 / size, shift = size * slopes[s];

    for (size_t i = 0; i < n; i++) {
        stage[i] += weighted_sum(couplings[s], s, stages + i, n) * inverse + shift * slope[i];
    }
}

/* A stage with the states where it is evaluated. */
static ALWAYS_INLINE Status do_stage(Solver *me, const int s, double end) {
    const double time = me->memory.time, size = end - time;
    double *stage = me->stages + (size_t)s * me->n;
    Status status = STATUS_OK;

    move_by_sums(me->n, me->x, 1.0, weights[s], s, me->stages, me->next);
    if (s == 0) {
        memcpy(stage, me->rates, me->n * sizeof *stage);
    } else {
        status = solver_rates(me, nodes[s] == 1.0 ? end : time + nodes[s] * size, me->next, stage);
    }
    couple(me->n, s, size, me->slope, me->stages, stage);
    solve(me->matrix, me->n, me->pivots, stage);
    return status;
}

/* Written out, so that the compiler knows the number of each stage. */
static Status do_stages(Solver *me, double end) {
    Status status = do_stage(me, 0, end);

    status = status <= STATUS_WARNING ? do_stage(me, 1, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, 2, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, 3, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, 4, end) : status;
    return status <= STATUS_WARNING ? do_stage(me, 5, end) : status;
}

static Status step(Solver *me, double end, double *error) {
    const double size = end - me->memory.time;
    const double *last = me->stages + (STAGES - 1) * me->n;
    Status status = solver_differentiate(me, size);

    if (status <= STATUS_WARNING) {
        prepare_matrix(me, size);
        status = do_stages(me, end);
    }
    for (size_t i = 0; i < me->n; i++) {
        me->next[i] += last[i];
    }
    *error = solver_norm(me, last);
    return status;
}

static Status between(Solver *me, double end, double fraction, double *x) {
    const double rest = 1.0 - fraction;

    (void)end;
    for (size_t i = 0; i < me->n; i++) {
        const double first = weighted_sum(dense[0], STAGES - 1, me->stages + i, me->n);
        const double second = weighted_sum(dense[1], STAGES - 1, me->stages + i, me->n);
        x[i] = me->x[i] * rest + fraction * (me->next[i] + rest * (first + fraction * second));
    }
    return STATUS_OK;
}

const Method rosenbrock = {.name = "rosenbrock",
                           .stages = STAGES,
                           .order = 4.0,
                           .needs_jacobian = true,
                           .step = step,
                           .between = between};
