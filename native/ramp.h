/* Inputs of FMI 1.0 and 2.0 that change linearly within a step: from the value of the last step to
 * that of this one. The FMU gets the value and the derivative at each communication point. */

#ifndef FMUGYM_RAMP_H
#define FMUGYM_RAMP_H

#include "fmi.h"

struct Solver;

/* What is kept of one input, and saved with the state. */
typedef struct {
    double from, to;
    double start; /* when it leaves the first value; NaN before the next step */
} Ramp;

/* To be called after initialization: the inputs rest at their values. */
Status ramps_begin(struct Solver *me);
/* Takes the values at the end of the next step of those references that have ramps. */
void ramps_aim(struct Solver *me, const uint32_t *references, size_t count, const double *values);
/* Sets values and derivatives for a communication step that begins at this time. */
Status ramps_set(struct Solver *me, double time);
/* Whether the input has a ramp. */
bool ramps_own(const struct Solver *me, uint32_t reference);

#endif
