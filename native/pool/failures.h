/* Failures: why the last status of an instance was worse than a warning. Also the health
 * counters. */

#ifndef FMUGYM_FAILURES_H
#define FMUGYM_FAILURES_H

#include "pool/pool.h"

static inline size_t index_of(const Pool *pool, const Instance *me) {
    return (size_t)(me - pool->instances);
}

static inline int64_t *health_of(const Pool *pool, const Instance *me) {
    return pool->settings.health + index_of(pool, me) * HEALTH_COUNTS;
}

/* Records a failure and returns it. Returns NULL if memory runs out; the status then has no
 * reason. */
Failure *failure_note(Instance *me, const char *doing, int status);
void failure_drop(Instance *me);

/* Records which calls are still legal after a status. */
Status instance_judge(Instance *me, Status status);
/* Handles a bad status of a call: records the reason and which calls are still legal. */
Status instance_fail(Pool *pool, Instance *me, const char *doing, Status status);
/* Handles a call that was refused before it reached the FMU. */
Status instance_refuse(Instance *me, const char *reason);
/* Records values that are not finite as the reason of the failure. */
Status instance_note_not_finite(Instance *me, const char *what, const double *values, size_t count);

void health_count_fault(const Pool *pool, const Instance *me, Status status);
/* Adds the steps since the last call to the health counters. Instances count their own steps. */
void health_count_steps(const Pool *pool, Instance *me);

#endif
