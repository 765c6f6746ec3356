/* Inputs that change linearly within a step of co-simulation: from the value of the last step to that of
 * this one. In FMI 1.0 and 2.0 the FMU gets the value and the derivative at each communication point, in
 * FMI 3.0 the value there and at each intermediate update. */

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
/* Sets the values at this time: the beginning of a communication step, for which it also sets derivatives, or
 * an intermediate update. */
Status ramps_set(struct Solver *me, double time);
/* Whether any input changes in this step. */
bool ramps_move(const struct Solver *me);
/* A communication step of an FMU that handles its events within it. */
Status ramps_step(struct Solver *me, double time, double size);
/* Whether the input has a ramp. */
bool ramps_own(const struct Solver *me, uint32_t reference);

#endif
