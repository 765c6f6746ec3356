/* Resets, by the reset method of the settings. */

#ifndef FMUGYM_INITIAL_STATES_H
#define FMUGYM_INITIAL_STATES_H

#include "steps.h"

/* Whether a reset with these start values restores a state. */
bool instance_knows_start(Pool *pool, Instance *me, const Access *start, const double *values);

/* Serializes the state of an instance that has just been reset. The caller frees the bytes. */
bool instance_pack(Pool *pool, Instance *me, char **bytes, size_t *size);

/* Lets an instance restore a serialized state at its next reset with the same start values. The
 * outputs decide then whether it is the same state. */
bool instance_adopt(Pool *pool, Instance *me, const Access *start, const Packed *packed);

Status instance_reset(Pool *pool, Instance *me, const Call *call, Scratch scratch);

#endif
