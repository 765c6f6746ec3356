/* The pools that a thread is inside. */

#ifndef FMUGYM_INSIDE_H
#define FMUGYM_INSIDE_H

#include "pool.h"

/* begin_inside records that this thread is inside a pool; end_inside ends that. */
void begin_inside(const Pool *pool);
void end_inside(void);

bool is_inside(const Pool *pool);

#endif
