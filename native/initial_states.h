/* Resets, by the reset method of the settings. */

#ifndef FMUGYM_INITIAL_STATES_H
#define FMUGYM_INITIAL_STATES_H

#include "steps.h"

/* Whether a reset with these start values restores a state. */
bool instance_knows_start(Pool *pool, Instance *me, const Access *start, const double *values);

Status instance_reset(Pool *pool, Instance *me, const Call *call, Scratch scratch);

#endif
