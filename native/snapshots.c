/* Snapshots: saved states of all instances. */

#include "snapshots.h"

#include <stdlib.h>

#include "failures.h"
#include "instances.h"

Snapshot *snapshot_new(size_t count) {
    return calloc(1, sizeof(Snapshot) + count * sizeof(Kept));
}

static bool is_own(const Pool *pool, const Kept *kept, size_t index) {
    return kept->state != NULL && kept->generation == pool->instances[index].generation;
}

static void unlink_snapshot(Pool *pool, const Snapshot *snapshot) {
    for (Snapshot **link = &pool->snapshots; *link != NULL; link = &(*link)->next) {
        if (*link == snapshot) {
            *link = snapshot->next;
            return;
        }
    }
}

/* A closed pool has already freed its states with its instances. */
static void drop_snapshot(Pool *pool, Snapshot *snapshot) {
    unlink_snapshot(pool, snapshot);
    for (size_t i = 0; i < pool->settings.count && pool->open; i++) {
        if (is_own(pool, &snapshot->kept[i], i)) {
            instance_free_state(pool, &pool->instances[i], &snapshot->kept[i].state);
        }
    }
    free(snapshot);
}

void pool_drop_abandoned(Pool *pool) {
    if (!atomic_get(&pool->abandoned)) {
        return;
    }
    atomic_set(&pool->abandoned, 0); /* cleared before the search: no later request is missed */
    for (Snapshot *snapshot = pool->snapshots, *next; snapshot != NULL; snapshot = next) {
        next = snapshot->next;
        if (atomic_get(&snapshot->abandoned)) {
            drop_snapshot(pool, snapshot);
        }
    }
}

void snapshots_drop_all(Pool *pool) {
    while (pool->snapshots != NULL) {
        drop_snapshot(pool, pool->snapshots);
    }
}

static Status save_instance(Pool *pool, Instance *me, Kept *kept) {
    if (me->phase != PHASE_STEPPING) {
        return instance_refuse(
            me, me->phase == PHASE_INSTANTIATED
                    ? "cannot save the FMU state before the first reset"
                    : "the instance needs a reset before its FMU state can be saved");
    }
    *kept = (Kept){NULL, me->steps, me->start_time, me->generation};
    return instance_save(pool, me, &kept->state);
}

ptrdiff_t pool_save(Pool *pool, Snapshot *snapshot) {
    pool->no_return = false;
    snapshot->next = pool->snapshots;
    pool->snapshots = snapshot;
    for (size_t i = 0; i < pool->settings.count; i++) {
        if (save_instance(pool, &pool->instances[i], &snapshot->kept[i]) > STATUS_WARNING) {
            drop_snapshot(pool, snapshot);
            return (ptrdiff_t)i;
        }
    }
    return -1;
}

bool snapshots_fit(const Pool *pool, const Snapshot *snapshot, Mask mask) {
    for (size_t i = 0; i < pool->settings.count; i++) {
        if ((mask.data == NULL || is_in(mask, i)) && !is_own(pool, &snapshot->kept[i], i)) {
            return false;
        }
    }
    return true;
}
