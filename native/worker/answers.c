/* What a worker sends. */

#include <stdlib.h>
#include <string.h>

#include "worker/worker.h"

/* Ends this process if an FMU has forked it and returned in it as well. */
static void end_twin(const Worker *w) {
    if (w->process != number_of_process()) {
        _Exit(0);
    }
}

void send_answer(Worker *w, Answer answer, Writer *writer) {
    end_twin(w);
    if (writer->failed) {
        end_without_memory();
    }
    send_message(&w->channel, answer, writer->bytes, writer->size);
    free(writer->bytes);
}

static void send_record(Worker *w, size_t index, int status, const char *category,
                        const char *text) {
    Writer writer = {.bytes = NULL};

    write_integer(&writer, (int64_t)index);
    write_integer(&writer, status);
    write_text(&writer, category);
    write_text(&writer, text);
    send_answer(w, ANSWER_LOG, &writer);
}

void worker_report(Worker *w) {
    size_t dropped;
    Message *first = log_take(&w->pool.log, &dropped);

    for (const Message *m = first; m != NULL; m = m->next) {
        send_record(w, m->index, m->status, m->category, m->text);
    }
    messages_free(first);
    if (dropped > 0) {
        send_record(w, 0, STATUS_WARNING, "fmugym",
                    "later messages were dropped: too many at once");
    }
}

void send_done(Worker *w) {
    Writer nothing = {.bytes = NULL};
    send_answer(w, ANSWER_RESULT, &nothing);
}

void send_error(Worker *w, const char *text) {
    Writer writer = {.bytes = NULL};
    const Answer answer = answer_refusal(&writer, text);
    send_answer(w, answer, &writer);
}

/* Outputs of a step whose answer cannot be sent are not published. */
void worker_publish(Worker *w) {
    const Shared *shared = &w->shared;
    const Settings *s = &w->opening.settings;

    end_twin(w);
    if (!channel_is_open(&w->channel)) {
        return;
    }
    pool_count_steps(&w->pool);
    memcpy(shared->outputs, w->output_values, s->outputs->count * s->count * sizeof(double));
    memcpy(shared->observations, w->observations, s->count * s->num_observed * sizeof(float));
    memcpy(shared->statuses, w->statuses, s->count);
}
