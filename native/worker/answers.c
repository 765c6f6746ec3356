/* Answers and messages. */

#include "answers.h"

#include <stdlib.h>
#include <string.h>

/* Kinds of errors: a sentence, or why the last status of an instance was bad. */
enum { ERROR_TEXT, ERROR_FAILURE };

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

void send_result(Writer *writer) {
    send_content(CODE_RESULT, writer->bytes, writer->size);
    free(writer->bytes);
}

void send_done(void) {
    send_content(CODE_RESULT, NULL, 0);
}

void send_error(const char *text) {
    Writer writer = {.bytes = NULL};

    write_bytes(&writer, &(char){ERROR_TEXT}, 1);
    write_text(&writer, text);
    send_content(CODE_ERROR, writer.bytes, writer.size);
    free(writer.bytes);
}

void write_failure(Worker *w, Writer *writer, size_t index) {
    Failure failure = {.doing = NULL};
    const bool found = pool_failure(&w->pool, index, &failure);

    write_bytes(writer, &found, 1);
    if (found) {
        write_text(writer, failure.doing);
        write_integer(writer, failure.in_warm_up);
        write_integer(writer, failure.status);
        write_number(writer, failure.time);
        write_integer(writer, failure.reference);
        write_text(writer, failure.said);
        write_integer(writer, failure.values != NULL);
        write_block(writer, failure.values, failure.number_of_values * sizeof(double));
        free(failure.said);
        free(failure.values);
    }
}

void send_failure(Worker *w, size_t index) {
    Writer writer = {.bytes = NULL};

    write_bytes(&writer, &(char){ERROR_FAILURE}, 1);
    write_integer(&writer, (int64_t)index);
    write_failure(w, &writer, index);
    send_content(CODE_ERROR, writer.bytes, writer.size);
    free(writer.bytes);
}

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
