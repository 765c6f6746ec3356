/* Snapshots: states of all instances. */

#ifndef FMUGYM_SNAPSHOTS_H
#define FMUGYM_SNAPSHOTS_H

#include "pool.h"

/* Frees the snapshots that were abandoned. */
void pool_drop_abandoned(Pool *pool);
/* Whether a snapshot has a state for each instance in a mask, or for all if there is none. */
bool snapshots_fit(const Pool *pool, const Snapshot *snapshot, Mask mask);
/* Frees all snapshots. Nobody may use them afterwards. */
void snapshots_drop_all(Pool *pool);

#endif
