/* Copies of a pool's library, for FMUs that make only so many instances with one. */

#ifndef FMUGYM_COPIES_H
#define FMUGYM_COPIES_H

#include "pool/pool.h"

/* Gives an instance that was discarded another library: the latest copy if others have it already,
 * otherwise a new one, and sets is_new. Returns whether it has got one. */
bool copy_take(Pool *pool, Instance *me, bool *is_new);
/* Returns an instance that was discarded to the library that it had at first. */
void copy_leave(Pool *pool, Instance *me);
/* Closes those that are left, after all instances. */
void copies_close(Pool *pool);

#endif
