/* Instances: made, freed, replaced, their states saved and restored. */

#ifndef FMUGYM_INSTANCES_H
#define FMUGYM_INSTANCES_H

#include "pool.h"

/* Returns whether the FMU could be instantiated. */
bool instance_build(Pool *pool, Instance *me);
/* Frees an instance and its states, as far as the standard allows it. */
void instance_discard(Pool *pool, Instance *me);
/* Returns to the state just after instantiation: resets, or replaces what refuses or is past any
 * reset. */
Status instance_return_to_start(Pool *pool, Instance *me);
/* Replaces an instance that is to be recycled because of leaks, or that no reset makes as new. */
Status instance_renew_if_due(Pool *pool, Instance *me);

Status instance_save(Pool *pool, Instance *me, void **state);
Status instance_restore(Pool *pool, Instance *me, void *state);
Status instance_free_state(const Pool *pool, Instance *me, void **state);

#endif
