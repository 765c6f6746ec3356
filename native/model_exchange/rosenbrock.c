/* Rodas5P, a stiffly accurate Rosenbrock method of order 5 with an estimate of order 4 and dense
 * output, for stiff equations: Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and
 * numerical benchmarks within the Julia Differential Equations package, BIT Numerical Mathematics
 * 63:27 (2023). The coefficients are those of the transformed form, which needs no product of
 * matrix and vector: Hairer, Wanner, Solving Ordinary Differential Equations II, section IV.7. */

#include <math.h>

#include "model_exchange/stages.h"

enum { STAGES = 8, TERMS = 3 /* of the dense output */ };

static const double gamma_ = 0.21193756319429014;
static const double nodes[STAGES] = {0.0, 0.6358126895828704, 0.4095798393397535,
                                     0.9769306725060716, 0.4288403609558664, 1.0, 1.0, 1.0};
static const double slopes[STAGES] = {0.21193756319429014, -0.42387512638858027,
                                      -0.3384627126235924, 1.8046452872882734, 2.325825639765069};

/* The last row plus the last stage gives the result; the last stage is the error. */
static const double weights[STAGES][STAGES] = {
    {0.0},
    {3.0},
    {2.849394379747939, 0.45842242204463923},
    {-6.954028509809101, 2.489845061869568, -10.358996098473584},
    {2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641},
    {-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256,
     0.030198172008377946},
    {-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256,
     0.030198172008377946, 1.0},
    {-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256,
     0.030198172008377946, 1.0, 1.0},
};

static const double couplings[STAGES][STAGES] = {
    {0.0},
    {-14.155112264123755},
    {-17.97296035885952, -2.859693295451294},
    {147.12150275711716, -1.41221402718213, 71.68940251302358},
    {165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306},
    {24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125,
     -0.6610691825249471},
    {30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783,
     -19.097331116725623, -28.087943162872662},
    {37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047,
     -40.06618937091002, -54.66780262877968, -9.48861652309627},
};

static const double dense[TERMS][STAGES] = {
    {25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204,
     0.524948541321073, 1.1241088310450404, 0.4272876194431874, -0.17202221070155493},
    {-9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796,
     20.176138334709044, 15.98066361424651, -6.789040303419874, -6.710236069923372},
    {11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643,
     -52.072871366152654, -59.78993625266729, -0.15582684282751913, 4.883087185713722},
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
static void factorize(double *matrix, size_t n, uint32_t *order) {
    for (size_t k = 0; k < n; k++) {
        order[k] = (uint32_t)k;
    }
    for (size_t k = 0; k < n; k++) {
        const size_t pivot = pivot_of(matrix, n, k);
        const uint32_t row_of_pivot = order[pivot];
        order[pivot] = order[k];
        order[k] = row_of_pivot;
        swap(matrix, n, k, pivot);
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

/* The order tells which element of b belongs to each row. The arrays do not overlap. */
static ALWAYS_INLINE void solve(const double *restrict matrix, size_t n,
                                const uint32_t *restrict order, const double *restrict b,
                                double *restrict x) {
    for (size_t row = 0; row < n; row++) {
        double value = b[order[row]];
        for (size_t i = 0; i < row; i++) {
            value -= matrix[row * n + i] * x[i];
        }
        x[row] = value;
    }
    for (size_t row = n; row-- > 0;) {
        double value = x[row];
        for (size_t i = row + 1; i < n; i++) {
            value -= matrix[row * n + i] * x[i];
        }
        x[row] = value * matrix[row * n + row];
    }
}

/* The same for two rows. Both results are stored at once: the next stage loads them so, and must
 * otherwise wait until each of two stores has reached the cache. */
static ALWAYS_INLINE void solve_two(const double *restrict matrix, const uint32_t *restrict order,
                                    const double *restrict b, double *restrict x) {
    const double above = b[order[0]], below = b[order[1]] - matrix[2] * above;
    const double second = below * matrix[3];

    store_pair((above - matrix[1] * second) * matrix[0], second, x);
}

static void prepare_matrix(Solver *me, double size) {
    const double diagonal = 1.0 / (size * gamma_);

    for (size_t i = 0; i < me->n * me->n; i++) {
        me->matrix[i] = -me->jacobian[i];
    }
    for (size_t i = 0; i < me->n; i++) {
        me->matrix[i * me->n + i] += diagonal;
    }
    factorize(me->matrix, me->n, me->order);
}

/* The right-hand side of a stage. The arrays do not overlap. */
static ALWAYS_INLINE void couple(size_t n, const int s, double size, const double *restrict rates,
                                 const double *restrict slope, const double *restrict stages,
                                 double *restrict side) {
    const double inverse = 1.0 / size, shift = size * slopes[s];

    for (size_t i = 0; i < n; i++) {
        const double sum = weighted_sum(couplings[s], s, stages + i, n);
        side[i] = rates[i] + (sum * inverse + shift * slope[i]);
    }
}

/* A stage with the states where it is evaluated. */
static ALWAYS_INLINE Status do_stage(Solver *me, size_t n, const int s, double end) {
    const double time = me->memory.time, size = end - time;
    double *rates = s == 0 ? me->rates : me->found, *side = me->trial;
    Status status = STATUS_OK;

    move_by_sums(n, me->x, 1.0, weights[s], s, me->stages, me->next);
    if (s > 0) {
        status = solver_rates(me, nodes[s] == 1.0 ? end : time + nodes[s] * size, me->next, rates);
    }
    couple(n, s, size, rates, me->slope, me->stages, side);
    if (n == 2) {
        solve_two(me->matrix, me->order, side, me->stages + (size_t)s * n);
    } else {
        solve(me->matrix, n, me->order, side, me->stages + (size_t)s * n);
    }
    return status;
}

/* Written out, so that the compiler knows the number of each stage. */
static ALWAYS_INLINE Status do_stages(Solver *me, size_t n, double end) {
    Status status = do_stage(me, n, 0, end);

    status = status <= STATUS_WARNING ? do_stage(me, n, 1, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, n, 2, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, n, 3, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, n, 4, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, n, 5, end) : status;
    status = status <= STATUS_WARNING ? do_stage(me, n, 6, end) : status;
    return status <= STATUS_WARNING ? do_stage(me, n, 7, end) : status;
}

/* Two states are common, and twice as fast where the compiler knows that there are two. */
static Status do_stages_of(Solver *me, double end) {
    return me->n == 2 ? do_stages(me, 2, end) : do_stages(me, me->n, end);
}

static Status step(Solver *me, double end, double *error) {
    const double size = end - me->memory.time;
    const double *last = me->stages + (STAGES - 1) * me->n;
    Status status = solver_differentiate(me, size);

    if (status <= STATUS_WARNING) {
        prepare_matrix(me, size);
        status = do_stages_of(me, end);
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
        const double *stages = me->stages + i;
        const double first = weighted_sum(dense[0], STAGES, stages, me->n);
        const double second = weighted_sum(dense[1], STAGES, stages, me->n);
        const double third = weighted_sum(dense[2], STAGES, stages, me->n);
        const double inner = first + fraction * (second + fraction * third);
        x[i] = me->x[i] * rest + fraction * (me->next[i] + rest * inner);
    }
    return STATUS_OK;
}

const Method rosenbrock = {.name = "rosenbrock",
                           .stages = STAGES,
                           .order = 5.0,
                           .needs_jacobian = true,
                           .step = step,
                           .between = between};
