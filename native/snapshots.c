#include "snapshots.h"

#include <stdlib.h>

#include "instances.h"

Snapshot *snapshot_new(Pool *pool, int64_t number) {
    Snapshot *snapshot = calloc(1, sizeof *snapshot + pool->settings.count * sizeof(Kept));

    if (snapshot != NULL) {
        snapshot->number = number;
        snapshot->next = pool->snapshots;
        pool->snapshots = snapshot;
    }
    return snapshot;
}

static Snapshot **link_to(Pool *pool, int64_t number) {
    Snapshot **link = &pool->snapshots;

    while (*link != NULL && (*link)->number != number) {
        link = &(*link)->next;
    }
    return link;
}

static bool is_own(const Pool *pool, const Kept *kept, size_t index) {
    return kept->state != NULL && kept->generation == pool->instances[index].generation;
}

void *snapshot_state(Pool *pool, int64_t number, size_t index) {
    const Snapshot *snapshot = *link_to(pool, number);

    return snapshot != NULL && is_own(pool, &snapshot->kept[index], index)
               ? snapshot->kept[index].state
               : NULL;
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
    Snapshot **link = link_to(pool, number);

    if (*link != NULL) {
        drop(pool, link);
    }
}

void snapshots_drop_all(Pool *pool) {
    while (pool->snapshots != NULL) {
        drop(pool, &pool->snapshots);
    }
}
