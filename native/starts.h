/* Starts of episodes, which draw, reset the instances and hand out the first observations. */

#ifndef FMUGYM_STARTS_H
#define FMUGYM_STARTS_H

#include "task.h"

/* A run of a step that plays. */
typedef struct {
    size_t begin, count;
    PlayScratch *registers;
    Verdict *verdict; /* on this run */
} PlayedRun;

/* Starts the next episodes of those environments of a run whose episodes have just ended without
 * trouble. Keeps their last observations. Adds to started how many they are, and returns how many
 * environments are in trouble. */
size_t starts_after_ends(Task *task, PlayedRun run, Scratch scratch, size_t *started);

/* Starts an episode outside of a step. Returns whether it is in trouble. */
size_t starts_one(Task *task, size_t index, Scratch scratch);

#endif
