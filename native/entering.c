#include "inside.h"
#include "snapshots.h"

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

/* The thread inside the pool may have checked for abandoned snapshots just before, so this
 * thread tries to enter and free the snapshot. If it cannot, the next thread to leave the pool
 * frees it. */
void pool_abandon(Pool *pool, Snapshot *snapshot) {
    atomic_set(&snapshot->abandoned, 1);
    atomic_set(&pool->abandoned, 1);
    if (mutex_try_lock(&pool->lock)) {
        begin_inside(pool);
        pool->floats = floats_now();
        pool_leave(pool);
    }
}
