/* How the work of a call is divided among threads. */

#ifndef FMUGYM_SCHEDULE_H
#define FMUGYM_SCHEDULE_H

#include "pool/runs.h"

/* Works on items 0 to count - 1. Returns how many instances have a status worse than a warning. */
size_t schedule_run(Task *task, size_t count);
/* The same of a task with start values, which may need more memory than the pool has. */
size_t schedule_run_with_starts(Task *task, size_t count);

/* Lists the instances in a mask, or all if there is none, for tasks that use a list. Returns
 * their number. */
size_t schedule_choose(Pool *pool, Mask mask);

/* Gives up on items because memory ran out: if even this little is missing, nothing else will
 * work either. The caller's arrays are still filled, with the previous values. */
size_t task_give_up(Task *task, size_t begin, size_t end);

#endif
