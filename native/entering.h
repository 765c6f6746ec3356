/* Taking turns in a pool. */

#ifndef FMUGYM_ENTERING_H
#define FMUGYM_ENTERING_H

#include "pool.h"

/* Notes that this thread is inside a pool, until it is no more. */
void begin_inside(const Pool *pool);
void end_inside(void);

#endif
