/* Starting episodes: drawing, resetting the instance, and writing the first observation. */

#ifndef FMUGYM_STARTS_H
#define FMUGYM_STARTS_H

#include "pool/play.h"
#include "pool/task.h"

/* A run of instances that have just been stepped and concluded. */
typedef struct {
    size_t begin, count;
    PlayScratch *scratch;
    Verdict *verdict; /* on this run */
} PlayedRun;

/* Starts the next episodes of the environments whose episodes have just ended without trouble, and
 * keeps their last observations. Adds their number to started. Returns how many of them are in
 * trouble. */
size_t starts_after_ends(Task *task, PlayedRun run, Scratch scratch, size_t *started);

/* Draws the start values of an instance, if there are any to draw, and resets it. Returns 1 if it is in
 * trouble, otherwise 0. */
size_t start_instance(Task *task, size_t index, Scratch scratch);

/* Starts episodes of the listed environments, at most RUN of them. Returns how many are in trouble. */
size_t start_episodes(Task *task, const uint32_t *starting, size_t count, Scratch scratch);

#endif
