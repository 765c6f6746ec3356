/* Instances: creating, freeing and replacing them, and saving and restoring their states. */

#ifndef FMUGYM_INSTANCES_H
#define FMUGYM_INSTANCES_H

#include "pool/pool.h"

/* Around a call that no other instance may make at the same time if the pool allows only one
 * initialization at a time. */
void instance_begin_turn(Pool *pool);
void instance_end_turn(Pool *pool);

/* Returns whether the FMU could be instantiated. */
bool instance_build(Pool *pool, Instance *me);
/* If the FMU failed without a message, makes an instance anew that logs everything until its next
 * reset. Returns false if it cannot be made, or if that was done too often. */
bool instance_rebuild_to_hear(Pool *pool, Instance *me);
/* Stops an FMU that logs more than it was asked for. */
void instance_hush(Pool *pool, Instance *me);
/* Frees an instance and its states, as far as FMI allows it. */
void instance_discard(Pool *pool, Instance *me);
/* Returns an instance to the state just after instantiation. Replaces the instance if it refuses
 * a reset or can no longer be reset. */
Status instance_return_to_start(Pool *pool, Instance *me);
/* Replaces an instance that a reset does not fully restore. */
Status instance_renew(Pool *pool, Instance *me);

Status instance_save(Pool *pool, Instance *me, void **state);
Status instance_restore(Pool *pool, Instance *me, void *state);
Status instance_free_state(const Pool *pool, Instance *me, void **state);

#endif
