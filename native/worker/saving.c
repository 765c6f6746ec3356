/* Requests for snapshots, serialized states and records. */

#include <stdlib.h>
#include <string.h>

#include "../bundles.h"
#include "../records.h"
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

/* Serialized states */

/* Reads a block of integers of 8 bytes; the caller frees them. */
static int64_t *read_integers(Reader *reader, size_t *count) {
    size_t size;
    const char *bytes = read_block(reader, &size);
    int64_t *numbers = memory_for(NULL, size);

    *count = size / sizeof *numbers;
    if (size > 0) {
        memcpy(numbers, bytes, size);
    }
    return numbers;
}

static bool can_serialize(const Worker *w) {
    return w->settings.can_save && w->settings.fmi->serialize != NULL;
}

void answer_bundle(Worker *w, Reader *reader) {
    size_t count;
    int64_t *indices = read_integers(reader, &count);
    int64_t *ends = memory_for(NULL, count * sizeof *ends);
    int64_t *steps = memory_for(NULL, count * sizeof *steps);
    double *start_times = memory_for(NULL, count * sizeof *start_times);
    Bundle bundle = {.bytes = NULL};

    if (!can_serialize(w) || !reader->sound) {
        send_error("the FMU cannot serialize its state");
    } else {
        pool_enter(&w->pool);
        const ptrdiff_t failed =
            pool_bundle(&w->pool, indices, count, &bundle, ends, steps, start_times);
        pool_leave(&w->pool);
        worker_report(w);
        if (failed >= 0) {
            send_failure(w, (size_t)failed);
        } else {
            Writer writer = {.bytes = NULL};
            write_block(&writer, bundle.bytes, bundle.size);
            write_block(&writer, ends, count * sizeof *ends);
            write_block(&writer, steps, count * sizeof *steps);
            write_block(&writer, start_times, count * sizeof *start_times);
            send_result(&writer);
        }
    }
    free(bundle.bytes);
    free(indices);
    free(ends);
    free(steps);
    free(start_times);
}

void answer_unbundle(Worker *w, Reader *reader) {
    size_t count, sources, size;
    int64_t *indices = read_integers(reader, &count);
    States states = {.sources = read_integers(reader, &sources)};

    states.ends = read_integers(reader, &states.count);
    states.steps = read_integers(reader, &size);
    int64_t *start_times = read_integers(reader, &size); /* of the same size as float64 */
    int64_t *outputs = read_integers(reader, &size);
    states.start_times = (const double *)start_times;
    states.outputs = (const double *)outputs;
    states.bytes = read_block(reader, &size);
    if (!can_serialize(w) || !reader->sound || count > w->settings.count) {
        send_error("the FMU cannot restore a serialized state");
    } else {
        pool_enter(&w->pool);
        for (size_t i = 0; i < count; i++) {
            w->pool.chosen[i] = (uint32_t)indices[i];
        }
        pool_unbundle(&w->pool, &states, count);
        pool_leave(&w->pool);
        worker_report(w);
        worker_publish(w);
        send_done();
    }
    free(indices);
    free(states.sources);
    free(states.ends);
    free(states.steps);
    free(start_times);
    free(outputs);
}

/* Records */

static void write_record(Writer *writer, const Record *record, size_t width) {
    write_integer(writer, (int64_t)record->number_of_starts);
    for (size_t i = 0; i < record->number_of_starts; i++) {
        write_integer(writer, record->starts[i].type);
        write_integer(writer, record->starts[i].reference);
        write_integer(writer, record->starts[i].place);
        write_number(writer, record->starts[i].value);
    }
    write_integer(writer, (int64_t)record->rows);
    write_bytes(writer, record->inputs, record->rows * width * sizeof(double));
}

/* Without a whole record the answer is empty. */
void answer_record_of(Worker *w, Reader *reader) {
    const size_t index = (size_t)read_integer(reader);
    Writer writer = {.bytes = NULL};
    Record record;

    if (index >= w->settings.count || !record_is_whole(&w->pool, index)) {
        send_result(&writer);
        return;
    }
    if (record_copy(&w->pool, index, &record)) {
        write_record(&writer, &record, w->settings.inputs->count);
        send_result(&writer);
    } else {
        send_error("out of memory");
    }
    record_clear(&record);
}

void answer_replace_record(Worker *w, Reader *reader) {
    const size_t index = (size_t)read_integer(reader), rows = (size_t)read_integer(reader);
    const size_t width = w->settings.inputs->count;
    Access start;

    if (!read_access(reader, w->settings.fmi, &start)) {
        send_error("a list of variables is damaged");
        return;
    }
    size_t values, size;
    int64_t *starts = read_integers(reader, &values); /* of the same size as float64 */
    int64_t *inputs = read_integers(reader, &size);
    if (reader->sound && index < w->settings.count && values == start.count &&
        size == rows * width) {
        pool_enter(&w->pool);
        record_begin(&w->pool, index, &start, (const double *)starts);
        for (size_t row = 0; row < rows; row++) {
            record_add(&w->pool, index, (const double *)inputs + row * width);
        }
        pool_leave(&w->pool);
        send_done();
    } else {
        send_error("a record is damaged");
    }
    free(starts);
    free(inputs);
    access_close(&start);
}
