/* Resets, by the reset method of the settings. */

#ifndef FMUGYM_INITIAL_STATES_H
#define FMUGYM_INITIAL_STATES_H

#include "pool/steps.h"

Status instance_reset(Pool *pool, Instance *me, const Call *call, Scratch scratch);

#endif
