/* Newton's method for the values x = y(x) of the links of an algebraic loop. */

#ifndef FMUGYM_LOOPS_H
#define FMUGYM_LOOPS_H

#include "fmi/fmi.h"

typedef struct {
    double tolerance;
    int64_t iterations; /* the most */
} LoopLimits;

/* Computes y of x. */
typedef Status Evaluate(void *context, const double *x, double *y);

/* How many doubles loop_solve needs for n unknowns. */
static inline size_t loop_memory(size_t n) {
    return n * (n + 3);
}

/* Begins at the x that it finds in its memory, and ends right after an evaluation that agrees with
 * its x. Returns Discard if there is none. Every status that is worse than a warning ends it. */
Status loop_solve(const LoopLimits *loop, size_t n, double *memory, Evaluate *evaluate, void *context);

#endif
