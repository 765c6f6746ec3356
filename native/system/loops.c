/* Newton's method for the algebraic loops of a system. */

#include "system/loops.h"

#include <math.h>

/* How far an unknown moves to see what depends on it, as a part of the larger of its magnitude and
 * 1. FMUs with solvers of their own have errors of this order. */
static const double NUDGE = 0x1p-14;

static bool agree(const LoopLimits *loop, size_t n, const double *x, const double *y) {
    for (size_t i = 0; i < n; i++) {
        const double size = fabs(y[i]) > 1.0 ? fabs(y[i]) : 1.0;
        if (!(fabs(y[i] - x[i]) <= loop->tolerance * size)) {
            return false;
        }
    }
    return true;
}

/* Fills row by row the matrix of x - y(x), differentiated by x. */
static Status differentiate(size_t n, double *x, const double *y, double *moved, double *matrix,
                            Evaluate *evaluate, void *context) {
    Status status = STATUS_OK;

    for (size_t j = 0; j < n && status <= STATUS_WARNING; j++) {
        const double here = x[j];
        const double size = fabs(here) > 1.0 ? fabs(here) : 1.0;
        x[j] = here + NUDGE * size;
        const double distance = x[j] - here;
        status = evaluate(context, x, moved);
        x[j] = here;
        for (size_t i = 0; i < n; i++) {
            matrix[i * n + j] = (i == j ? 1.0 : 0.0) - (moved[i] - y[i]) / distance;
        }
    }
    return status;
}

static void swap_rows(size_t n, double *matrix, double *right, size_t one, size_t other) {
    for (size_t j = 0; j < n; j++) {
        const double kept = matrix[one * n + j];
        matrix[one * n + j] = matrix[other * n + j];
        matrix[other * n + j] = kept;
    }
    const double kept = right[one];
    right[one] = right[other];
    right[other] = kept;
}

static size_t largest_of_column(size_t n, const double *matrix, size_t column) {
    size_t best = column;
    for (size_t i = column + 1; i < n; i++) {
        best = fabs(matrix[i * n + column]) > fabs(matrix[best * n + column]) ? i : best;
    }
    return best;
}

/* Gaussian elimination; the solution takes the place of the right side. Returns false if the matrix
 * is singular. */
static bool solve_linear(size_t n, double *matrix, double *right) {
    for (size_t k = 0; k < n; k++) {
        swap_rows(n, matrix, right, k, largest_of_column(n, matrix, k));
        if (!(fabs(matrix[k * n + k]) > 0.0)) {
            return false;
        }
        for (size_t i = k + 1; i < n; i++) {
            const double factor = matrix[i * n + k] / matrix[k * n + k];
            for (size_t j = k; j < n; j++) {
                matrix[i * n + j] -= factor * matrix[k * n + j];
            }
            right[i] -= factor * right[k];
        }
    }
    for (size_t k = n; k-- > 0;) {
        for (size_t j = k + 1; j < n; j++) {
            right[k] -= matrix[k * n + j] * right[j];
        }
        right[k] /= matrix[k * n + k];
    }
    return true;
}

/* Moves x by a step of Newton's method, or to y if there is none. */
static Status improve(size_t n, double *x, const double *y, double *rest, double *matrix,
                      Evaluate *evaluate, void *context) {
    const Status status = differentiate(n, x, y, rest, matrix, evaluate, context);

    for (size_t i = 0; i < n; i++) {
        rest[i] = y[i] - x[i];
    }
    const bool solved = status <= STATUS_WARNING && solve_linear(n, matrix, rest);
    for (size_t i = 0; i < n; i++) {
        x[i] = solved && isfinite(rest[i]) ? x[i] + rest[i] : y[i];
    }
    return status;
}

Status loop_solve(const LoopLimits *loop, size_t n, double *memory, Evaluate *evaluate, void *context) {
    double *x = memory, *y = memory + n, *rest = memory + 2 * n, *matrix = memory + 3 * n;

    for (int64_t i = 0; i < loop->iterations; i++) {
        Status status = evaluate(context, x, y);
        if (status > STATUS_WARNING || agree(loop, n, x, y)) {
            return status;
        }
        status = improve(n, x, y, rest, matrix, evaluate, context);
        if (status > STATUS_WARNING) {
            return status;
        }
    }
    return STATUS_DISCARD;
}
