/* Snapshots: saved states of all instances. */

#include "pool/snapshots.h"

#include <stdlib.h>

#include "pool/failures.h"
#include "pool/instances.h"

static bool is_own(const Pool *pool, const Kept *kept, size_t index) {
    return kept->state != NULL && kept->generation == pool->instances[index].generation;
}

static void drop(Pool *pool, Snapshot **link) {
    Snapshot *snapshot = *link;

    *link = snapshot->next;
    for (size_t i = 0; i < pool->settings.count; i++) {
        if (is_own(pool, &snapshot->kept[i], i)) {
            instance_free_state(pool, &pool->instances[i], &snapshot->kept[i].state);
        }
    }
    free(snapshot);
}

void snapshot_drop(Pool *pool, int64_t number) {
    for (Snapshot **link = &pool->snapshots; *link != NULL; link = &(*link)->next) {
        if ((*link)->number == number) {
            drop(pool, link);
            return;
        }
    }
}

void snapshots_drop_all(Pool *pool) {
    while (pool->snapshots != NULL) {
        drop(pool, &pool->snapshots);
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

ptrdiff_t snapshot_save(Pool *pool, int64_t number, const int64_t *indices, size_t count) {
    Snapshot *snapshot = calloc(1, sizeof *snapshot + pool->settings.count * sizeof(Kept));

    pool->no_return = false;
    if (snapshot == NULL) {
        instance_refuse(&pool->instances[0], "out of memory");
        return 0;
    }
    snapshot->number = number;
    snapshot->next = pool->snapshots;
    pool->snapshots = snapshot;
    for (size_t i = 0; i < count; i++) {
        const size_t index = (size_t)indices[i];
        if (save_instance(pool, &pool->instances[index], &snapshot->kept[index]) > STATUS_WARNING) {
            drop(pool, &pool->snapshots);
            return (ptrdiff_t)index;
        }
    }
    return -1;
}

const Snapshot *snapshot_of(const Pool *pool, int64_t number, const int64_t *indices,
                            size_t count) {
    const Snapshot *snapshot = pool->snapshots;

    while (snapshot != NULL && snapshot->number != number) {
        snapshot = snapshot->next;
    }
    for (size_t i = 0; i < count && snapshot != NULL; i++) {
        const size_t index = (size_t)indices[i];
        snapshot = is_own(pool, &snapshot->kept[index], index) ? snapshot : NULL;
    }
    return snapshot;
}
