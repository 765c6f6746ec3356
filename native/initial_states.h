/* Resets, by the cheapest way that gives the same as a fresh instance. */

#ifndef FMUGYM_INITIAL_STATES_H
#define FMUGYM_INITIAL_STATES_H

#include "steps.h"

Status instance_reset(Pool *pool, Instance *me, const Call *call, Scratch scratch);

#endif
