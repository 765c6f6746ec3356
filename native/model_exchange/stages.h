/* Weighted sums of the stages of a method of integration. */

#ifndef FMUGYM_STAGES_H
#define FMUGYM_STAGES_H

#include "model_exchange/equations.h"
#include "shared/platform.h"

/* The sum of the first stages of one state, added in their order. Faster where the compiler knows
 * how many they are. */
static ALWAYS_INLINE double weighted_sum(const double *factors, int count, const double *stages,
                                         size_t n) {
    double total = count == 0 ? 0.0 : factors[0] * stages[0];

    for (int j = 1; j < count; j++) {
        total += factors[j] * stages[(size_t)j * n];
    }
    return total;
}

/* Moves all states by such sums. The arrays do not overlap. */
static ALWAYS_INLINE void move_by_sums(size_t n, const double *restrict x, double scale,
                                       const double *factors, int count,
                                       const double *restrict stages, double *restrict moved) {
    for (size_t i = 0; i < n; i++) {
        moved[i] = x[i] + scale * weighted_sum(factors, count, stages + i, n);
    }
}

/* Stores two neighbours at once. */
static ALWAYS_INLINE void store_pair(double first, double second, double *to) {
#if defined __GNUC__
    typedef double Pair __attribute__((vector_size(16), aligned(8), may_alias));
    *(Pair *)(void *)to = (Pair){first, second};
#else
    to[0] = first;
    to[1] = second;
#endif
}

#endif
