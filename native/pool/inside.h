/* The pools that a thread is inside. */

#ifndef FMUGYM_INSIDE_H
#define FMUGYM_INSIDE_H

#include "model_exchange/interruption.h"
#include "pool/pool.h"

/* begin_inside records that this thread is inside a pool; end_inside ends that. */
void begin_inside(Pool *pool);
void end_inside(void);

bool is_inside(const Pool *pool);

/* Whoever calls a pool may want its work to end early, because a signal has come. */
typedef struct {
    bool (*wants_end)(void *context);
    void *context;
} Caller;

/* Sets that of this thread, and returns the one before. There is none at first. */
Caller inside_of_caller(Caller caller);

#endif
