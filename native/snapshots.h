/* Snapshots: states that FMUs have copied in their own memory. The owner of the pool numbers them. */

#ifndef FMUGYM_SNAPSHOTS_H
#define FMUGYM_SNAPSHOTS_H

#include "pool.h"

/* Returns NULL if memory runs out. */
Snapshot *snapshot_new(Pool *pool, int64_t number);
/* The state of an instance in a snapshot; NULL if there is none, or if the instance was replaced. */
void *snapshot_state(Pool *pool, int64_t number, size_t index);
/* Frees a snapshot, if there is one of this number. */
void snapshot_drop(Pool *pool, int64_t number);
void snapshots_drop_all(Pool *pool);

#endif
