/* Directional and adjoint derivatives of the instances of a pool. */

#ifndef FMUGYM_DERIVATIVES_H
#define FMUGYM_DERIVATIVES_H

#include "pool/pool.h"

/* What to differentiate. For a directional derivative the seeded variables are the knowns and the
 * others the unknowns; for an adjoint one it is the other way round. */
typedef struct {
    bool adjoint;
    size_t part; /* the FMU of a system whose variables they are; otherwise 0 */
    const Access *seeded, *others;
} Question;

/* Differentiates at the current communication point, after the inputs were set. Fills an array of
 * shape (seeded, others, instances). Returns the index of the first instance that fails, or -1. */
ptrdiff_t pool_differentiate(Pool *pool, Matrix inputs, const Question *question,
                             double *derivatives);

#endif
