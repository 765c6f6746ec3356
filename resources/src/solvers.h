/* The integration methods, in the order of the items of the enumeration "solver". */

#ifndef SOLVERS_H
#define SOLVERS_H

#include "model.h"

#if MODEL_ORDER == 2
enum { EXPLICIT_EULER = 1, SEMI_IMPLICIT_EULER = 2, RK4 = 3 };
#else /* without pairs of position and velocity, there is no semi-implicit method */
enum { EXPLICIT_EULER = 1, RK4 = 2, SEMI_IMPLICIT_EULER = 0 };
#endif

/* Advances the state by a number of equal steps. The inputs in r stay constant. */
void integrate(const Reals *r, const Constants *k, int32_t solver, double step, int32_t number,
               double *state);

#endif
