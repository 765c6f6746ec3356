/* Why the last status of an instance was worse than a warning, and what is counted of it. */

#ifndef FMUGYM_FAILURES_H
#define FMUGYM_FAILURES_H

#include "pool.h"

static inline size_t index_of(const Pool *pool, const Instance *me) {
    return (size_t)(me - pool->instances);
}

static inline int64_t *health_of(const Pool *pool, const Instance *me) {
    return pool->settings.health + index_of(pool, me) * HEALTH_COUNTS;
}

/* Notes a failure and returns it; NULL without memory: then there is a status and no reason. */
Failure *failure_note(Instance *me, const char *doing, int status);
void failure_drop(Instance *me);

/* Notes which calls are still legal after a status. */
Status instance_judge(Instance *me, Status status);
/* A call returned a bad status: notes which calls are still legal, and why. */
Status instance_fail(Pool *pool, Instance *me, const char *doing, Status status);
/* A call was not even made. */
Status instance_refuse(Instance *me, const char *reason);
/* Values that are not finite are the reason. */
Status instance_note_not_finite(Instance *me, const char *what, const double *values, size_t count);

void health_count_fault(const Pool *pool, const Instance *me, Status status);
/* Adds the steps since the last time; steps count themselves. */
void health_count_steps(const Pool *pool, Instance *me);

#endif
