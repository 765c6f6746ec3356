/* Which pools a thread is inside of. */

#ifndef FMUGYM_INSIDE_H
#define FMUGYM_INSIDE_H

#include "pool.h"

/* Notes that this thread is inside a pool, until it is no more. */
void begin_inside(const Pool *pool);
void end_inside(void);

bool is_inside(const Pool *pool);

#endif
