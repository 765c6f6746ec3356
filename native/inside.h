/* The pools that a thread is inside, and what it asks the FMU for. */

#ifndef FMUGYM_INSIDE_H
#define FMUGYM_INSIDE_H

#include "mark.h"
#include "pool.h"

/* begin_inside records that this thread is inside a pool; end_inside ends that. */
void begin_inside(const Pool *pool);
void end_inside(void);

bool is_inside(const Pool *pool);

/* The same for a pool of Python, which has only a mark. */
void begin_inside_python(const Mark *mark, FmuCall call);
void end_inside_python(void);

/* Records what this thread is about to ask the FMU for. Between two such calls it is CALL_STEP,
 * so that steps need not record anything. */
void begin_call(FmuCall call);
void end_call(void);

/* For signal handlers: the mark of the pool that this thread is inside, or NULL; and the call. */
const Mark *inside_mark(void);
FmuCall inside_call(void);

#endif
