/* Signals that arrive while an FMU works whose code is Python: see handlers.c. */

#ifndef FMUGYM_HANDLERS_H
#define FMUGYM_HANDLERS_H

#include "python/python.h"

enum { MOST_HELD = 32 };

/* The handlers that are held back. */
typedef struct {
    size_t count;
    int numbers[MOST_HELD];
    PyObject *handlers[MOST_HELD];
    PyObject *raised; /* by a handler that ran before; see handlers_hold_at_the_end */
} Held;

/* Must be called once before anything else. Returns false with an exception. */
bool handlers_prepare(void);

/* From now on signals are only noted, if this is the main thread. Returns false with what a handler has
 * raised before that; nothing is held then. */
bool handlers_hold(Held *held);

/* Runs the handlers of the signals that were noted. Returns false with the first exception, or with the
 * one that there was before. */
bool handlers_release(Held *held);

/* The same two where nothing can be raised, as when an object is freed: what a handler raises comes at
 * the next instruction of Python, and the handlers of the signals that were noted run there. */
void handlers_hold_at_the_end(Held *held);
void handlers_postpone(Held *held);

#endif
