/* The loop of a worker. */

#include <stdlib.h>

#include "worker/worker.h"

static const size_t LARGEST_REQUEST = (size_t)1 << 40; /* bytes; no memory is as large */

/* Whether an instance has a status worse than a warning, be it in the mask or not. */
static bool is_troubled(const Worker *w) {
    bool troubled = false;

    for (size_t i = 0; i < w->opening.settings.count; i++) {
        troubled |= w->statuses[i] > STATUS_WARNING;
    }
    return troubled;
}

static void answer_step(Worker *w) {
    const Call call = {.inputs = shared_inputs(w),
                       .mask = {w->shared.mask, 1},
                       .observations = w->observations};
    Writer nothing = {.bytes = NULL};

    pool_enter(&w->pool);
    pool_step(&w->pool, &call);
    pool_leave(&w->pool);
    worker_report(w);
    worker_publish(w);
    send_answer(w, is_troubled(w) ? ANSWER_TROUBLE : ANSWER_RESULT, &nothing);
}

static Answer answer_close(Worker *w) {
    pool_close(&w->pool);
    return ANSWER_RESULT;
}

static Answer answer_in_pool(Worker *w, Request request, Reader *reader, Writer *writer) {
    return request == REQUEST_START   ? answer_start(w, reader, writer)
           : request == REQUEST_CLOSE ? answer_close(w)
                                      : pool_answer(&w->pool, shared_inputs(w), request, reader,
                                                    writer);
}

static void answer_other(Worker *w, Request request, Reader *reader) {
    Writer writer = {.bytes = NULL};

    pool_enter(&w->pool);
    const Answer answer = answer_in_pool(w, request, reader, &writer);
    pool_leave(&w->pool);
    worker_report(w);
    if (request == REQUEST_START || request == REQUEST_RESTORE) {
        worker_publish(w);
    }
    send_answer(w, answer, &writer);
}

static void answer(Worker *w, Request request, Reader *reader) {
    if (request == REQUEST_STEP) {
        answer_step(w);
    } else {
        answer_other(w, request, reader);
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
        answer(w, (Request)head.code, &reader);
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
