/* Work on runs of instances. */

#ifndef FMUGYM_RUNS_H
#define FMUGYM_RUNS_H

#include "pool/task.h"

/* All three work on the items from begin to end and return how many instances have a status
 * worse than a warning. This one resets or restores instances that need not be neighbours: */
size_t run_listed(Task *task, size_t begin, size_t end, Scratch scratch);
/* This one steps or resets: */
size_t run_steps(Task *task, size_t begin, size_t end, Scratch scratch);
/* This one does the same and runs the programs before and after, or only the latter if the step was
 * done elsewhere: */
size_t run_play(Task *task, size_t begin, size_t end, Scratch scratch);
/* Runs what comes before a step that is done elsewhere. Returns 0. */
size_t run_before(Task *task, size_t begin, size_t end);

#endif
