/* The answers to requests. */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../bundles.h"
#include "../records.h"
#include "worker.h"

/* Windows' own header of this function needs another library. */
typedef struct {
    DWORD size, page_faults;
    SIZE_T peak_working_set, working_set, quotas[4], pagefile, peak_pagefile;
} MemoryCounters;
WINBASEAPI BOOL WINAPI K32GetProcessMemoryInfo(HANDLE process, MemoryCounters *counters,
                                               DWORD size);

enum { FIRST_RESETS = 4 }; /* of each instance; what they take is no leak */

/* In the order of fmugym/pool/process/windows.py */
enum {
    REQUEST_RESET,
    REQUEST_BEGIN_BY,
    REQUEST_SAVE,
    REQUEST_RESTORE,
    REQUEST_WRITE,
    REQUEST_BUNDLE,
    REQUEST_UNBUNDLE,
    REQUEST_RECORD_OF,
    REQUEST_COUNT_STEPS,
    REQUEST_FAILURE,
    REQUEST_READ,
    REQUEST_REPLACE_RECORD,
    REQUEST_RENEW,
    REQUEST_CLOSE,
    REQUESTS
};

/* Kinds of errors: a sentence, or why the last status of an instance was bad. */
enum { ERROR_TEXT, ERROR_FAILURE };

/* Messages */

static void send_message(size_t index, int status, const char *category, const char *text) {
    Writer writer = {.bytes = NULL};

    write_integer(&writer, (int64_t)index);
    write_integer(&writer, status);
    write_text(&writer, category);
    write_text(&writer, text);
    send_content(CODE_LOG, writer.bytes, writer.size);
    free(writer.bytes);
}

void worker_report(Worker *w) {
    size_t dropped;
    Message *first = log_take(&w->pool.log, &dropped);

    for (const Message *m = first; m != NULL; m = m->next) {
        send_message(m->index, m->status, m->category, m->text);
    }
    messages_free(first);
    if (dropped > 0) {
        send_message(0, STATUS_WARNING, "fmugym", "later messages were dropped: too many at once");
    }
}

static void send_result(Writer *writer) {
    send_content(CODE_RESULT, writer->bytes, writer->size);
    free(writer->bytes);
}

static void send_done(void) {
    send_content(CODE_RESULT, NULL, 0);
}

static void send_error(const char *text) {
    Writer writer = {.bytes = NULL};

    write_bytes(&writer, &(char){ERROR_TEXT}, 1);
    write_text(&writer, text);
    send_content(CODE_ERROR, writer.bytes, writer.size);
    free(writer.bytes);
}

/* Whether there is a failure is the first byte. */
static void write_failure(Worker *w, Writer *writer, size_t index) {
    Failure failure = {.doing = NULL};
    const bool found = pool_failure(&w->pool, index, &failure);

    write_bytes(writer, &found, 1);
    if (found) {
        write_text(writer, failure.doing);
        write_integer(writer, failure.in_warm_up);
        write_integer(writer, failure.status);
        write_number(writer, failure.time);
        write_integer(writer, failure.string_reference);
        write_text(writer, failure.said);
        write_integer(writer, failure.values != NULL);
        write_block(writer, failure.values, failure.number_of_values * sizeof(double));
        free(failure.said);
        free(failure.values);
    }
}

static void send_failure(Worker *w, size_t index) {
    Writer writer = {.bytes = NULL};

    write_bytes(&writer, &(char){ERROR_FAILURE}, 1);
    write_integer(&writer, (int64_t)index);
    write_failure(w, &writer, index);
    send_content(CODE_ERROR, writer.bytes, writer.size);
    free(writer.bytes);
}

/* Steps */

void worker_publish(Worker *w) {
    const Shared *shared = &w->shared;
    const size_t count = w->settings.count;

    for (size_t i = 0; i < w->outputs.count; i++) {
        memcpy(shared->outputs + i * shared->stride, w->output_values + i * count,
               count * sizeof(double));
    }
    memcpy(shared->observations, w->observations,
           count * w->settings.num_observed * sizeof(float));
    memcpy(shared->statuses, w->statuses, count);
}

static Matrix shared_inputs(const Worker *w) {
    return (Matrix){(const char *)w->shared.inputs, (ptrdiff_t)(w->shared.stride * sizeof(double)),
                    sizeof(double)};
}

void worker_step(Worker *w, bool some) {
    Call call = {.inputs = shared_inputs(w), .observations = w->observations};

    if (some) {
        call.mask = (Mask){w->shared.mask, 1};
    }
    pool_enter(&w->pool);
    bool troubled = pool_step(&w->pool, &call) > 0;
    pool_leave(&w->pool);
    for (size_t i = 0; some && !troubled && i < w->settings.count; i++) {
        troubled = w->statuses[i] > STATUS_WARNING; /* also of those in the mask */
    }
    worker_report(w);
    worker_publish(w);
    send_code(troubled ? CODE_TROUBLE : CODE_FINE);
}

/* Resets */

/* A list comes with its number the first time, and later as the number only. */
static const Access *find_list(Worker *w, Reader *reader) {
    const int64_t number = read_integer(reader);

    if (read_flag(reader)) {
        List *lists = realloc(w->lists, (w->number_of_lists + 1) * sizeof *lists);
        if (lists == NULL) {
            return NULL;
        }
        w->lists = lists;
        w->lists[w->number_of_lists].number = number;
        if (!read_access(reader, w->settings.fmi, &w->lists[w->number_of_lists].access)) {
            return NULL;
        }
        w->number_of_lists++;
    }
    for (size_t i = 0; i < w->number_of_lists; i++) {
        if (w->lists[i].number == number) {
            return &w->lists[i].access;
        }
    }
    return NULL;
}

static int64_t memory_of_process(void) {
    MemoryCounters counters = {.size = sizeof counters};
    const BOOL known = K32GetProcessMemoryInfo(GetCurrentProcess(), &counters, sizeof counters);
    return known ? (int64_t)counters.working_set : 0;
}

/* By how many bytes the process has grown since its first resets. */
static int64_t growth_after(Worker *w, const char *mask) {
    for (size_t i = 0; i < w->settings.count; i++) {
        w->resets += mask[i] != 0;
    }
    if (w->resets < FIRST_RESETS * (int64_t)w->settings.count) {
        return 0;
    }
    const int64_t now = memory_of_process();
    w->first_memory = w->first_memory == 0 ? now : w->first_memory;
    return now - w->first_memory;
}

/* The values of a list of variables, one column for each instance. */
static Matrix read_values(Worker *w, Reader *reader, const Access *access) {
    const ptrdiff_t row = (ptrdiff_t)(w->settings.count * sizeof(double));
    const size_t count = access == NULL ? 0 : access->count;
    return (Matrix){read_bytes(reader, count * (size_t)row), row, sizeof(double)};
}

static void answer_reset(Worker *w, Reader *reader) {
    const Access *start = find_list(w, reader);
    const Matrix values = read_values(w, reader, start);
    const char *mask = read_bytes(reader, w->settings.count);
    const Call call = {
        .inputs = shared_inputs(w), .mask = {mask, 1}, .start = start, .start_values = values};

    if (start == NULL || !reader->sound) {
        send_error("a reset is damaged");
        return;
    }
    pool_enter(&w->pool);
    pool_reset(&w->pool, &call);
    pool_leave(&w->pool);
    worker_report(w);
    worker_publish(w);
    Writer writer = {.bytes = NULL};
    write_integer(&writer, growth_after(w, mask));
    write_integer(&writer, (int64_t)number_of_initializations());
    send_result(&writer);
}

static void answer_begin_by(Worker *w, Reader *reader) {
    const bool rebuilds = read_flag(reader);

    pool_enter(&w->pool);
    pool_begin_by(&w->pool, false, rebuilds);
    const bool kept = w->pool.records != NULL || records_open(&w->pool);
    pool_leave(&w->pool);
    if (kept) {
        send_done();
    } else {
        send_error("out of memory");
    }
}

/* Snapshots */

/* Returns whether there is a place for another snapshot. */
static bool has_place(Worker *w) {
    Snapshot **snapshots =
        realloc(w->snapshots, (w->number_of_snapshots + 1) * sizeof(Snapshot *));
    w->snapshots = snapshots == NULL ? w->snapshots : snapshots;
    return snapshots != NULL;
}

static void answer_save(Worker *w, Reader *reader) {
    Snapshot *snapshot = has_place(w) ? snapshot_new(w->settings.count) : NULL;

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
    w->snapshots[w->number_of_snapshots++] = snapshot;
    send_result(&writer);
}

static Snapshot **snapshot_of(Worker *w, int64_t number) {
    const bool known = number >= 0 && (size_t)number < w->number_of_snapshots;
    return known && w->snapshots[number] != NULL ? &w->snapshots[number] : NULL;
}

static void answer_restore(Worker *w, Reader *reader) {
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

/* Variables */

static void answer_write(Worker *w, Reader *reader) {
    Access access;

    if (!read_access(reader, w->settings.fmi, &access)) {
        send_error("a list of variables is damaged");
        return;
    }
    const Matrix values = read_values(w, reader, &access);
    ptrdiff_t failed = -1;
    if (reader->sound) {
        double *copy = malloc(access.count * (size_t)values.row_stride + 1); /* aligned */
        memcpy(copy, values.data, access.count * (size_t)values.row_stride);
        pool_enter(&w->pool);
        failed = pool_write(&w->pool, &access, copy);
        pool_leave(&w->pool);
        free(copy);
    }
    access_close(&access);
    worker_report(w);
    if (failed >= 0) {
        send_failure(w, (size_t)failed);
    } else {
        send_done();
    }
}

static void answer_read(Worker *w, Reader *reader) {
    Access access;

    if (!read_access(reader, w->settings.fmi, &access)) {
        send_error("a list of variables is damaged");
        return;
    }
    const size_t size = access.count * w->settings.count * sizeof(double);
    double *values = calloc(1, size + 1);
    pool_enter(&w->pool);
    const ptrdiff_t failed = pool_read(&w->pool, &access, values);
    pool_leave(&w->pool);
    worker_report(w);
    if (failed >= 0) {
        send_failure(w, (size_t)failed);
    } else {
        send_content(CODE_RESULT, values, size);
    }
    free(values);
    access_close(&access);
}

/* Serialized states */

/* Reads a block of integers of 8 bytes; the caller frees them. */
static int64_t *read_integers(Reader *reader, size_t *count) {
    size_t size;
    const char *bytes = read_block(reader, &size);
    int64_t *numbers = malloc(size + 1);

    *count = size / sizeof *numbers;
    reader->sound = reader->sound && numbers != NULL;
    if (reader->sound) {
        memcpy(numbers, bytes, size);
    }
    return numbers;
}

static bool can_serialize(const Worker *w) {
    return w->settings.can_save && w->settings.fmi->serialize != NULL;
}

static void answer_bundle(Worker *w, Reader *reader) {
    size_t count;
    int64_t *indices = read_integers(reader, &count);
    int64_t *ends = calloc(count + 1, sizeof *ends), *steps = calloc(count + 1, sizeof *steps);
    Bundle bundle = {.bytes = NULL};

    if (!can_serialize(w) || !reader->sound) {
        send_error("the FMU cannot serialize its state");
    } else {
        pool_enter(&w->pool);
        const ptrdiff_t failed = pool_bundle(&w->pool, indices, count, &bundle, ends, steps);
        pool_leave(&w->pool);
        worker_report(w);
        if (failed >= 0) {
            send_failure(w, (size_t)failed);
        } else {
            Writer writer = {.bytes = NULL};
            write_block(&writer, bundle.bytes, bundle.size);
            write_block(&writer, ends, count * sizeof *ends);
            write_block(&writer, steps, count * sizeof *steps);
            send_result(&writer);
        }
    }
    free(bundle.bytes);
    free(indices);
    free(ends);
    free(steps);
}

static void answer_unbundle(Worker *w, Reader *reader) {
    size_t count, sources, size;
    int64_t *indices = read_integers(reader, &count);
    States states = {.sources = read_integers(reader, &sources)};

    states.ends = read_integers(reader, &states.count);
    states.steps = read_integers(reader, &size);
    int64_t *outputs = read_integers(reader, &size); /* of the same size as float64 */
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
    free(outputs);
}

/* Questions */

/* Without a whole record the answer is empty. */
static void answer_record_of(Worker *w, Reader *reader) {
    const size_t index = (size_t)read_integer(reader);
    const bool known = w->pool.records != NULL && index < w->settings.count;
    const Record *record = known ? &w->pool.records[index] : NULL;
    Writer writer = {.bytes = NULL};

    if (record != NULL && record->whole) {
        write_integer(&writer, (int64_t)record->number_of_starts);
        for (size_t i = 0; i < record->number_of_starts; i++) {
            write_integer(&writer, record->starts[i].type);
            write_integer(&writer, record->starts[i].reference);
            write_number(&writer, record->starts[i].value);
        }
        write_integer(&writer, (int64_t)record->rows);
        write_bytes(&writer, record->inputs,
                    record->rows * w->settings.inputs->count * sizeof(double));
    }
    send_result(&writer);
}

static void answer_replace_record(Worker *w, Reader *reader) {
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

static void answer_count_steps(Worker *w, Reader *reader) {
    (void)reader;
    pool_enter(&w->pool);
    pool_count_steps(&w->pool);
    pool_leave(&w->pool);
    send_done();
}

static void answer_renew(Worker *w, Reader *reader) {
    (void)reader;
    pool_enter(&w->pool);
    pool_replace(&w->pool, DUE_AS_USED);
    pool_leave(&w->pool);
    send_done();
}

static void answer_failure(Worker *w, Reader *reader) {
    const int64_t index = read_integer(reader);
    Writer writer = {.bytes = NULL};

    if (index < 0 || (size_t)index >= w->settings.count) {
        send_error("there is no such instance");
        return;
    }
    write_failure(w, &writer, (size_t)index);
    send_result(&writer);
}

static void answer_close(Worker *w, Reader *reader) {
    (void)reader;
    pool_enter(&w->pool);
    pool_close(&w->pool);
    pool_leave(&w->pool);
    worker_report(w);
    send_done();
}

bool worker_answer(Worker *w, Reader *reader) {
    static void (*const answers[REQUESTS])(Worker *, Reader *) = {
        [REQUEST_RESET] = answer_reset,
        [REQUEST_BEGIN_BY] = answer_begin_by,
        [REQUEST_SAVE] = answer_save,
        [REQUEST_RESTORE] = answer_restore,
        [REQUEST_WRITE] = answer_write,
        [REQUEST_BUNDLE] = answer_bundle,
        [REQUEST_UNBUNDLE] = answer_unbundle,
        [REQUEST_RECORD_OF] = answer_record_of,
        [REQUEST_COUNT_STEPS] = answer_count_steps,
        [REQUEST_FAILURE] = answer_failure,
        [REQUEST_READ] = answer_read,
        [REQUEST_REPLACE_RECORD] = answer_replace_record,
        [REQUEST_RENEW] = answer_renew,
        [REQUEST_CLOSE] = answer_close,
    };
    const uint8_t request = read_flag(reader);

    if (request >= REQUESTS) {
        send_error("workers in Wine cannot do this");
        return true;
    }
    answers[request](w, reader);
    return request != REQUEST_CLOSE;
}
