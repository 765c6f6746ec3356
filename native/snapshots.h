/* Snapshots: states of all instances. */

#ifndef FMUGYM_SNAPSHOTS_H
#define FMUGYM_SNAPSHOTS_H

#include "pool.h"

/* Frees those that were abandoned. */
void pool_drop_abandoned(Pool *pool);
/* Frees all; nobody has them any more. */
void snapshots_drop_all(Pool *pool);

#endif
