/* Requests for snapshots and for states as values. */

#include <stdlib.h>
#include <string.h>

#include "../states.h"
#include "worker.h"

/* Snapshots */

void answer_save(Worker *w, Reader *reader) {
    const bool able = w->opening.settings.can_save;
    Snapshot *snapshot = able ? snapshot_new(w->opening.settings.count) : NULL;

    (void)reader;
    if (snapshot == NULL) {
        send_error(w, able ? "out of memory" : "the FMU cannot get and set its state");
        return;
    }
    pool_enter(&w->pool);
    const ptrdiff_t failed = pool_save(&w->pool, snapshot);
    pool_leave(&w->pool);
    worker_report(w);
    if (failed >= 0) {
        send_failure(w, (size_t)failed);
        return;
    }
    Writer writer = {.bytes = NULL};
    write_integer(&writer, (int64_t)w->number_of_snapshots);
    w->snapshots =
        memory_for(w->snapshots, (w->number_of_snapshots + 1) * sizeof *w->snapshots);
    w->snapshots[w->number_of_snapshots++] = snapshot;
    send_result(w, &writer);
}

static Snapshot **snapshot_of(Worker *w, int64_t number) {
    const bool known = number >= 0 && (size_t)number < w->number_of_snapshots;
    return known && w->snapshots[number] != NULL ? &w->snapshots[number] : NULL;
}

void answer_restore(Worker *w, Reader *reader) {
    Snapshot **snapshot = snapshot_of(w, read_integer(reader));
    const Block mask = read_block(reader);
    size_t troubled;

    if (snapshot == NULL || mask.size != w->opening.settings.count) {
        send_error(w, "there is no such snapshot");
        return;
    }
    pool_enter(&w->pool);
    const bool own = pool_restore(&w->pool, *snapshot, (Mask){mask.bytes, 1}, &troubled);
    pool_leave(&w->pool);
    worker_report(w);
    if (!own) {
        send_error(w, "the snapshot is of another instance than this one");
        return;
    }
    worker_publish(w);
    send_done(w);
}

void answer_release(Worker *w, Reader *reader) {
    size_t count;
    const int64_t *numbers = read_array(reader, sizeof *numbers, &count);

    for (size_t i = 0; i < count; i++) {
        Snapshot **snapshot = snapshot_of(w, numbers[i]);
        if (snapshot != NULL) {
            pool_abandon(&w->pool, *snapshot);
            *snapshot = NULL;
        }
    }
}

/* States as values */

/* Numbers of instances, each there once, so that no two threads work on it. */
static const int64_t *read_instances(Worker *w, Reader *reader, size_t *count) {
    const size_t n = w->opening.settings.count;
    const int64_t *indices = read_array(reader, sizeof *indices, count);
    char *seen = memory_for(NULL, n);

    memset(seen, 0, n);
    for (size_t i = 0; i < *count; i++) {
        if (indices[i] < 0 || (size_t)indices[i] >= n || seen[indices[i]]) {
            reader_refuse(reader, "a list of instances is damaged");
            break;
        }
        seen[indices[i]] = 1;
    }
    free(seen);
    return indices;
}

static void send_states(Worker *w, const Bytes *all, const int64_t *ends, size_t count) {
    Writer writer = {.bytes = NULL};
    int64_t begin = 0;

    write_integer(&writer, (int64_t)count);
    for (size_t i = 0; i < count; i++) {
        write_block(&writer, all->bytes + begin, (size_t)(ends[i] - begin));
        begin = ends[i];
    }
    send_result(w, &writer);
}

void answer_save_states(Worker *w, Reader *reader) {
    size_t count;
    const int64_t *indices = read_instances(w, reader, &count);
    const bool records = read_flag(reader);
    Bytes all = {.bytes = NULL};

    if (reader->fault != NULL) {
        send_error(w, reader->fault);
        return;
    }
    int64_t *ends = memory_for(NULL, count * sizeof *ends);
    pool_enter(&w->pool);
    const ptrdiff_t failed = pool_save_states(&w->pool, indices, count, records, &all, ends);
    pool_leave(&w->pool);
    worker_report(w);
    if (failed >= 0) {
        send_failure(w, (size_t)failed);
    } else {
        send_states(w, &all, ends, count);
    }
    free(all.bytes);
    free(ends);
}

/* A state for each of some instances; the caller frees them. */
static State *read_states(Worker *w, Reader *reader, size_t count) {
    State *states = memory_for(NULL, count * sizeof *states);

    for (size_t i = 0; i < count && reader->fault == NULL; i++) {
        const Block block = read_block(reader);
        states[i] = (State){block.bytes, block.size};
        if (reader->fault == NULL && !state_is_sound(&w->pool, states[i])) {
            reader_refuse(reader, "a state is damaged, or not of this FMU");
        }
    }
    return states;
}

void answer_restore_states(Worker *w, Reader *reader) {
    size_t count;
    const int64_t *indices = read_instances(w, reader, &count);
    State *states = read_states(w, reader, count);

    if (reader->fault != NULL) {
        send_error(w, reader->fault);
    } else {
        pool_enter(&w->pool);
        for (size_t i = 0; i < count; i++) {
            w->pool.chosen[i] = (uint32_t)indices[i];
        }
        pool_restore_states(&w->pool, states, count);
        pool_leave(&w->pool);
        worker_report(w);
        worker_publish(w);
        send_done(w);
    }
    free(states);
}
