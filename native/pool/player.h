/* Calls of a pool with programs around its steps. */

#ifndef FMUGYM_PLAYER_H
#define FMUGYM_PLAYER_H

#include "pool/play.h"
#include "pool/pool.h"

/* What became of the episodes in a call that plays. */
typedef struct {
    size_t ended;   /* how many are at their ends */
    size_t started; /* how many of these were followed by another one in the same step */
    bool outside;   /* whether a hook looked up an index outside of a table */
} Ends;

/* The following functions return how many instances now have a status worse than a warning, or numbers
 * that are not finite. Their callers are inside the pool. */

/* Resets the instances whose episode has ended and steps the others. Runs the programs of the
 * turn before and after. Writes all observations. */
size_t pool_play(Pool *pool, const Call *call, Ends *ends);
/* The two parts of a play around steps that are done elsewhere. The first runs the program that comes
 * before, and keeps the outputs; it fails nowhere. The second takes the outputs and statuses for those of
 * the step. The turn has no arrays for episodes that start in it. */
void pool_play_before(Pool *pool, const Call *call);
size_t pool_play_after(Pool *pool, const Call *call, Ends *ends);
/* Starts the episodes of the turn in the mask. Writes all observations, and tells how many episodes are
 * at their ends now. */
size_t pool_start(Pool *pool, const Call *call, Ends *ends);

#endif
