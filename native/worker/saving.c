/* Requests for snapshots and for states as values. */

#include <stdlib.h>
#include <string.h>

#include "../states.h"
#include "answers.h"

/* Snapshots */

void answer_save(Worker *w, Reader *reader) {
    Snapshot *snapshot = snapshot_new(w->settings.count);

    (void)reader;
    if (!w->settings.can_save || snapshot == NULL) {
        send_error(snapshot == NULL ? "out of memory" : "the FMU cannot get and set its state");
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
    send_result(&writer);
}

static Snapshot **snapshot_of(Worker *w, int64_t number) {
    const bool known = number >= 0 && (size_t)number < w->number_of_snapshots;
    return known && w->snapshots[number] != NULL ? &w->snapshots[number] : NULL;
}

void answer_restore(Worker *w, Reader *reader) {
    Snapshot **snapshot = snapshot_of(w, read_integer(reader));
    const Mask mask = {read_bytes(reader, w->settings.count), 1};
    size_t troubled;

    if (snapshot == NULL || !reader->sound) {
        send_error("there is no such snapshot");
        return;
    }
    pool_enter(&w->pool);
    const bool own = pool_restore(&w->pool, *snapshot, mask, &troubled);
    pool_leave(&w->pool);
    worker_report(w);
    if (!own) {
        send_error("the snapshot is of another instance than this one");
        return;
    }
    worker_publish(w);
    send_done();
}

void worker_release(Worker *w, Reader *reader) {
    const int64_t count = read_integer(reader);

    for (int64_t i = 0; i < count && reader->sound; i++) {
        Snapshot **snapshot = snapshot_of(w, read_integer(reader));
        if (snapshot != NULL) {
            pool_abandon(&w->pool, *snapshot);
            *snapshot = NULL;
        }
    }
}

/* States as values */

/* Reads a block of indices; the caller frees them. */
static int64_t *read_indices(Reader *reader, size_t *count) {
    size_t size;
    const char *bytes = read_block(reader, &size);
    int64_t *numbers = memory_for(NULL, size);

    *count = size / sizeof *numbers;
    if (size > 0) {
        memcpy(numbers, bytes, size);
    }
    return numbers;
}

static void send_states(const Bytes *all, const int64_t *ends, size_t count) {
    Writer writer = {.bytes = NULL};
    int64_t begin = 0;

    for (size_t i = 0; i < count; i++) {
        write_block(&writer, all->bytes + begin, (size_t)(ends[i] - begin));
        begin = ends[i];
    }
    send_result(&writer);
}

void answer_save_states(Worker *w, Reader *reader) {
    size_t count;
    int64_t *indices = read_indices(reader, &count);
    int64_t *ends = memory_for(NULL, count * sizeof *ends);
    const bool records = read_flag(reader);
    Bytes all = {.bytes = NULL};

    if (!reader->sound) {
        send_error("a list of instances is damaged");
    } else {
        pool_enter(&w->pool);
        const ptrdiff_t failed = pool_save_states(&w->pool, indices, count, records, &all, ends);
        pool_leave(&w->pool);
        worker_report(w);
        if (failed >= 0) {
            send_failure(w, (size_t)failed);
        } else {
            send_states(&all, ends, count);
        }
    }
    free(all.bytes);
    free(indices);
    free(ends);
}

/* Reads a state for each of some instances; the caller frees them. Returns NULL if one is damaged. */
static State *read_states(Worker *w, Reader *reader, size_t count) {
    State *states = memory_for(NULL, count * sizeof *states);
    bool sound = count <= w->settings.count;

    for (size_t i = 0; i < count && sound; i++) {
        states[i].bytes = read_block(reader, &states[i].size);
        sound = reader->sound && state_is_sound(&w->pool, states[i]);
    }
    if (!sound) {
        free(states);
    }
    return sound ? states : NULL;
}

void answer_restore_states(Worker *w, Reader *reader) {
    size_t count;
    int64_t *indices = read_indices(reader, &count);
    State *states = read_states(w, reader, count);

    if (states == NULL) {
        send_error("the FMU cannot restore a state");
    } else {
        pool_enter(&w->pool);
        for (size_t i = 0; i < count; i++) {
            w->pool.chosen[i] = (uint32_t)indices[i];
        }
        pool_restore_states(&w->pool, states, count);
        pool_leave(&w->pool);
        worker_report(w);
        worker_publish(w);
        send_done();
    }
    free(states);
    free(indices);
}
