#include "entering.h"

#include "snapshots.h"

/* Which pools a thread is inside of: an FMU written in Python that calls its own pool gets an error
 * instead of waiting for itself. */

enum { NESTED = 8 }; /* deeper ones are not noticed */

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

static bool is_inside(const Pool *pool) {
    for (size_t i = 0; i < inside.depth && i < NESTED; i++) {
        if (inside.pools[i] == pool) {
            return true;
        }
    }
    return false;
}

static Entry enter_locked(Pool *pool) {
    if (!pool->open) {
        mutex_unlock(&pool->lock);
        return ENTRY_CLOSED;
    }
    begin_inside(pool);
    pool->floats = floats_now();
    return ENTRY_ENTERED;
}

Entry pool_try_enter(Pool *pool) {
    if (is_inside(pool)) {
        return ENTRY_INSIDE;
    }
    return mutex_try_lock(&pool->lock) ? enter_locked(pool) : ENTRY_BUSY;
}

Entry pool_enter(Pool *pool) {
    if (is_inside(pool)) {
        return ENTRY_INSIDE;
    }
    mutex_lock(&pool->lock);
    return enter_locked(pool);
}

void pool_leave(Pool *pool) {
    pool_drop_abandoned(pool);
    floats_restore(&pool->floats);
    end_inside();
    mutex_unlock(&pool->lock);
}
