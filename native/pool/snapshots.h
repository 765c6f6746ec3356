/* Snapshots: states that FMUs have copied in their own memory. The owner of the pool numbers them. */

#ifndef FMUGYM_SNAPSHOTS_H
#define FMUGYM_SNAPSHOTS_H

#include "pool/pool.h"

enum { NO_SNAPSHOT = 0 }; /* no number of one */

/* Saves instances in a new snapshot. Returns the index of the first that fails, or -1. */
ptrdiff_t snapshot_save(Pool *pool, int64_t number, const int64_t *indices, size_t count);
/* Returns NULL if there is none of this number, or if one of the instances is not in it or has been
 * replaced since. */
const Snapshot *snapshot_of(const Pool *pool, int64_t number, const int64_t *indices, size_t count);
/* Frees a snapshot, if there is one of this number. */
void snapshot_drop(Pool *pool, int64_t number);
void snapshots_drop_all(Pool *pool);

#endif
