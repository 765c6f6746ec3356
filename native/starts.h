/* Starts of episodes, which draw, reset the instances and hand out the first observations. */

#ifndef FMUGYM_STARTS_H
#define FMUGYM_STARTS_H

#include "runs.h"

/* Starts the next episodes of those environments of a run whose episodes have just ended without
 * trouble. Keeps their last observations. Counts them in started, and returns how many of the new
 * episodes are in trouble. */
size_t starts_after_ends(Task *task, size_t begin, size_t count, Scratch scratch, size_t *started);

/* Starts an episode outside of a step. Returns whether it is in trouble. */
size_t starts_one(Task *task, size_t index, Scratch scratch);

#endif
