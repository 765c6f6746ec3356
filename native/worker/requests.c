/* The answers to requests. */

#include <stdlib.h>
#include <string.h>

#include "../derivatives.h"
#include "../texts.h"
#include "answers.h"

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
    REQUEST_SAVE,
    REQUEST_RESTORE,
    REQUEST_WRITE,
    REQUEST_SAVE_STATES,
    REQUEST_RESTORE_STATES,
    REQUEST_COUNT_STEPS,
    REQUEST_FAILURE,
    REQUEST_READ,
    REQUEST_DIFFERENTIATE,
    REQUEST_TEXT_OF,
    REQUEST_CLOSE,
    REQUESTS
};

/* Steps */

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
        w->lists = memory_for(w->lists, (w->number_of_lists + 1) * sizeof *w->lists);
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
        double *copy = memory_for(NULL, access.count * (size_t)values.row_stride); /* aligned */
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
    double *values = memory_for(NULL, size);
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

static void answer_question(Worker *w, const Question *question) {
    const size_t size =
        question->seeded->count * question->others->count * w->settings.count * sizeof(double);
    double *derivatives = memory_for(NULL, size);

    pool_enter(&w->pool);
    const ptrdiff_t failed = pool_differentiate(&w->pool, shared_inputs(w), question, derivatives);
    pool_leave(&w->pool);
    worker_report(w);
    if (failed >= 0) {
        send_failure(w, (size_t)failed);
    } else {
        send_content(CODE_RESULT, derivatives, size);
    }
    free(derivatives);
}

static void answer_differentiate(Worker *w, Reader *reader) {
    const bool adjoint = read_flag(reader);
    Access seeded = {.count = 0}, others = {.count = 0};

    if (read_access(reader, w->settings.fmi, &seeded) &&
        read_access(reader, w->settings.fmi, &others)) {
        const Question question = {adjoint, 0, &seeded, &others};
        answer_question(w, &question);
    } else {
        send_error("a list of variables is damaged");
    }
    access_close(&seeded);
    access_close(&others);
}

/* Questions */

static void answer_count_steps(Worker *w, Reader *reader) {
    (void)reader;
    pool_enter(&w->pool);
    pool_count_steps(&w->pool);
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

static void answer_text_of(Worker *w, Reader *reader) {
    Writer writer = {.bytes = NULL};

    (void)w;
    write_text(&writer, text_with(read_number(reader)));
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
        [REQUEST_SAVE] = answer_save,
        [REQUEST_RESTORE] = answer_restore,
        [REQUEST_WRITE] = answer_write,
        [REQUEST_SAVE_STATES] = answer_save_states,
        [REQUEST_RESTORE_STATES] = answer_restore_states,
        [REQUEST_COUNT_STEPS] = answer_count_steps,
        [REQUEST_FAILURE] = answer_failure,
        [REQUEST_READ] = answer_read,
        [REQUEST_DIFFERENTIATE] = answer_differentiate,
        [REQUEST_TEXT_OF] = answer_text_of,
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
