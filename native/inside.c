#include "inside.h"

/* The pools that a thread is inside. An FMU written in Python may call its own pool. It gets an
 * error instead of a deadlock. */

enum { NESTED = 8 }; /* deeper nesting is not noticed */

static THREAD_LOCAL struct {
    const Pool *pools[NESTED];
    size_t depth;
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
