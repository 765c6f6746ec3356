#include "snapshots.h"

#include <stdlib.h>

#include "failures.h"
#include "instances.h"

Snapshot *snapshot_new(size_t count) {
    Snapshot *snapshot = calloc(1, sizeof *snapshot);

    if (snapshot == NULL) {
        return NULL;
    }
    snapshot->states = calloc(count, sizeof *snapshot->states);
    snapshot->steps = calloc(count, sizeof *snapshot->steps);
    snapshot->start_times = calloc(count, sizeof *snapshot->start_times);
    snapshot->generations = calloc(count, sizeof *snapshot->generations);
    if (snapshot->states == NULL || snapshot->steps == NULL || snapshot->start_times == NULL ||
        snapshot->generations == NULL) {
        snapshot_free(snapshot);
        return NULL;
    }
    return snapshot;
}

void snapshot_free(Snapshot *snapshot) {
    free(snapshot->states);
    free(snapshot->steps);
    free(snapshot->start_times);
    free(snapshot->generations);
    free(snapshot);
}

static bool is_own(const Pool *pool, const Snapshot *snapshot, size_t index) {
    return snapshot->states[index] != NULL &&
           snapshot->generations[index] == pool->instances[index].generation;
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
        if (is_own(pool, snapshot, i)) {
            instance_free_state(pool, &pool->instances[i], &snapshot->states[i]);
        }
    }
    snapshot_free(snapshot);
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

static Status save_instance(Pool *pool, Instance *me, Snapshot *snapshot) {
    const size_t index = index_of(pool, me);

    if (me->phase != PHASE_STEPPING) {
        return instance_refuse(
            me, me->phase == PHASE_INSTANTIATED
                    ? "cannot save the FMU state before the first reset"
                    : "the instance needs a reset before its FMU state can be saved");
    }
    snapshot->generations[index] = me->generation;
    snapshot->steps[index] = me->steps;
    snapshot->start_times[index] = me->start_time;
    return instance_save(pool, me, &snapshot->states[index]);
}

ptrdiff_t pool_save(Pool *pool, Snapshot *snapshot) {
    pool->no_return = false;
    snapshot->next = pool->snapshots;
    pool->snapshots = snapshot;
    for (size_t i = 0; i < pool->settings.count; i++) {
        if (save_instance(pool, &pool->instances[i], snapshot) > STATUS_WARNING) {
            drop_snapshot(pool, snapshot);
            return (ptrdiff_t)i;
        }
    }
    return -1;
}

bool snapshots_fit(const Pool *pool, const Snapshot *snapshot, Mask mask) {
    for (size_t i = 0; i < pool->settings.count; i++) {
        if ((mask.data == NULL || is_in(mask, i)) && !is_own(pool, snapshot, i)) {
            return false;
        }
    }
    return true;
}
