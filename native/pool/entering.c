/* Entry into a pool by one thread at a time, and exit from it. */

#include "pool/inside.h"

/* The pools that a thread is inside. An FMU written in Python may call its own pool. It gets an
 * error instead of a deadlock. */

enum { NESTED = 8 }; /* deeper nesting is not noticed */

static const uint64_t PATIENCE = 20000000; /* ns from one question to the caller to the next one */

static THREAD_LOCAL struct {
    Pool *pools[NESTED];
    size_t depth;
    Caller caller;
    uint64_t asked; /* when the caller was asked last */
} inside;

void begin_inside(Pool *pool) {
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

static Pool *innermost(void) {
    return inside.depth > 0 && inside.depth <= NESTED ? inside.pools[inside.depth - 1] : NULL;
}

Caller inside_of_caller(Caller caller) {
    const Caller before = inside.caller;

    inside.caller = caller;
    return before;
}

static bool caller_wants_end(void) {
    const uint64_t now = clock_now();

    if (inside.caller.wants_end == NULL || now - inside.asked < PATIENCE) {
        return false;
    }
    inside.asked = now;
    return inside.caller.wants_end(inside.caller.context);
}

bool is_interrupted(void) {
    Pool *pool = innermost();

    if (pool != NULL && !atomic_get(&pool->interrupted) && caller_wants_end()) {
        atomic_set(&pool->interrupted, 1);
    }
    return pool != NULL && atomic_get(&pool->interrupted);
}

bool is_first_to_find_stiff(void) {
    Pool *pool = innermost();
    return pool != NULL && !atomic_or_bits(&pool->found_stiff, 1);
}

static Entry enter_locked(Pool *pool) {
    if (!pool->open) {
        mutex_unlock(&pool->lock);
        return ENTRY_CLOSED;
    }
    begin_inside(pool);
    atomic_set(&pool->interrupted, 0);
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
    floats_restore(&pool->floats);
    end_inside();
    mutex_unlock(&pool->lock);
}
