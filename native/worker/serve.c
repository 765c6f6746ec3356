/* The loop of a worker. */

#include <stdlib.h>

#include "../texts.h"
#include "worker.h"

static const size_t LARGEST_REQUEST = (size_t)1 << 40; /* bytes; no memory is as large */

static void answer_step(Worker *w, bool some) {
    Call call = {.inputs = shared_inputs(w), .observations = w->observations};
    Writer nothing = {.bytes = NULL};

    if (some) {
        call.mask = (Mask){w->shared.mask, 1};
    }
    pool_enter(&w->pool);
    bool troubled = pool_step(&w->pool, &call) > 0;
    pool_leave(&w->pool);
    for (size_t i = 0; some && !troubled && i < w->opening.settings.count; i++) {
        troubled = w->statuses[i] > STATUS_WARNING; /* also of those in the mask */
    }
    worker_report(w);
    worker_publish(w);
    send_answer(w, troubled ? ANSWER_TROUBLE : ANSWER_FINE, &nothing);
}

static void answer_count_steps(Worker *w, Reader *reader) {
    (void)reader;
    pool_enter(&w->pool);
    pool_count_steps(&w->pool);
    pool_leave(&w->pool);
    send_done(w);
}

static void answer_failure(Worker *w, Reader *reader) {
    const int64_t last = (int64_t)w->opening.settings.count - 1;
    const size_t index = (size_t)read_integer_in(reader, 0, last);
    Writer writer = {.bytes = NULL};

    if (reader->fault != NULL) {
        send_error(w, "there is no such instance");
        return;
    }
    write_failure(w, &writer, index);
    send_result(w, &writer);
}

static void answer_text_of(Worker *w, Reader *reader) {
    Writer writer = {.bytes = NULL};

    write_text(&writer, text_with(read_number(reader)));
    send_result(w, &writer);
}

static void answer_close(Worker *w, Reader *reader) {
    (void)reader;
    pool_enter(&w->pool);
    pool_close(&w->pool);
    pool_leave(&w->pool);
    worker_report(w);
    send_done(w);
}

static void answer(Worker *w, uint64_t request, Reader *reader) {
    static void (*const answers[REQUESTS])(Worker *, Reader *) = {
        [REQUEST_RESET] = answer_reset,
        [REQUEST_SAVE] = answer_save,
        [REQUEST_RESTORE] = answer_restore,
        [REQUEST_RELEASE] = answer_release,
        [REQUEST_WRITE] = answer_write,
        [REQUEST_READ] = answer_read,
        [REQUEST_SAVE_STATES] = answer_save_states,
        [REQUEST_RESTORE_STATES] = answer_restore_states,
        [REQUEST_COUNT_STEPS] = answer_count_steps,
        [REQUEST_FAILURE] = answer_failure,
        [REQUEST_DIFFERENTIATE] = answer_differentiate,
        [REQUEST_ROLL_OUT] = answer_roll_out,
        [REQUEST_TEXT_OF] = answer_text_of,
        [REQUEST_CLOSE] = answer_close,
    };

    if (request == REQUEST_STEP || request == REQUEST_STEP_SOME) {
        answer_step(w, request == REQUEST_STEP_SOME);
    } else {
        answers[request](w, reader);
    }
}

/* The content of a request; NULL if the other end is gone, or asks for too much. */
static char *content_of(Worker *w, Head head) {
    char *content = head.size > LARGEST_REQUEST ? NULL : malloc((size_t)head.size + 1);

    if (content != NULL && !receive_content(&w->channel, content, (size_t)head.size)) {
        free(content);
        content = NULL;
    }
    return content;
}

/* Returns whether the worker goes on. The first request, and no other one, opens the pool. */
static bool serve_one(Worker *w, Head head, bool is_first) {
    if (head.code >= REQUESTS || (head.code == REQUEST_OPEN) != is_first) {
        return false;
    }
    char *content = head.size == 0 ? NULL : content_of(w, head);
    if (content == NULL && head.size > 0) {
        return false;
    }
    Reader reader = {content, content == NULL ? NULL : content + head.size, NULL};
    bool goes_on = head.code != REQUEST_CLOSE;
    if (is_first) {
        goes_on = answer_open(w, &reader);
    } else {
        answer(w, head.code, &reader);
    }
    free(content);
    return goes_on;
}

void worker_serve(Worker *w) {
    Head head;

    w->process = number_of_process();
    for (bool is_first = true; receive_head(&w->channel, &head); is_first = false) {
        if (!serve_one(w, head, is_first)) {
            return;
        }
    }
}
