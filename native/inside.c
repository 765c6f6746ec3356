#include "inside.h"

/* The pools that a thread is inside. An FMU written in Python may call its own pool. It gets an
 * error instead of a deadlock. */

enum { NESTED = 8 }; /* deeper nesting is not noticed */

static THREAD_LOCAL struct {
    const Pool *pools[NESTED];
    size_t depth;
    const Mark *mark; /* of the Python pool that the thread is inside */
    volatile FmuCall call;
} inside;

void begin_inside(const Pool *pool) {
    if (inside.depth < NESTED) {
        inside.pools[inside.depth] = pool;
    }
    inside.depth++;
}

void end_inside(void) {
    inside.depth--;
}

bool is_inside(const Pool *pool) {
    for (size_t i = 0; i < inside.depth && i < NESTED; i++) {
        if (inside.pools[i] == pool) {
            return true;
        }
    }
    return false;
}

void begin_inside_python(const Mark *mark, FmuCall call) {
    inside.call = call;
    inside.mark = mark;
}

void end_inside_python(void) {
    inside.mark = NULL;
    inside.call = CALL_STEP;
}

void begin_call(FmuCall call) {
    inside.call = call;
}

void end_call(void) {
    inside.call = CALL_STEP;
}

const Mark *inside_mark(void) {
    const size_t depth = inside.depth < NESTED ? inside.depth : NESTED;
    return depth > 0 ? inside.pools[depth - 1]->settings.mark : inside.mark;
}

FmuCall inside_call(void) {
    return inside.call;
}
