/* Rollouts: many steps of each environment, one run of environments after the other. */

#ifndef FMUGYM_ROLLOUTS_H
#define FMUGYM_ROLLOUTS_H

#include "runs.h"

/* Does task->horizon steps with each environment, where all arrays of the turn but the drawn values
 * have a row for each step. The items from begin to end are runs. An episode that has ended takes no
 * more steps: its last observation stays. Returns how many instances or numbers were in trouble;
 * the environments of that run have then not done all steps. */
size_t run_rollout(Task *task, size_t begin, size_t end, Scratch scratch);

#endif
