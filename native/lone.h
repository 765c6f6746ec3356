/* The step of a pool's only instance, without what moves the values of many at once: that takes
 * longer than a step of a light FMU. */

#ifndef FMUGYM_LONE_H
#define FMUGYM_LONE_H

#include "task.h"

/* Whether this task is such a step. The calling thread is inside the pool. */
bool lone_fits(const Task *task);
/* Returns whether the status of the instance is worse than a warning. */
size_t lone_step(Task *task);

#endif
