/* Requests: what the owner of a pool asks of it besides its steps, as forms. The owner is in this process,
 * or has a worker in another one. fmugym/pool/engine.py writes requests and reads answers. */

#ifndef FMUGYM_REQUESTS_H
#define FMUGYM_REQUESTS_H

#include "forms/form.h"
#include "forms/writer.h"
#include "pool/states.h"

/* In the order of fmugym/pool/engine.py. Each of them has one answer. */
typedef enum {
    REQUEST_OPEN,
    REQUEST_STEP,
    REQUEST_START,
    REQUEST_READ,
    REQUEST_WRITE,
    REQUEST_DIFFERENTIATE,
    REQUEST_SAVE,
    REQUEST_RESTORE,
    REQUEST_FAILURE,
    REQUEST_CLOSE,
    REQUESTS
} Request;

/* Answers, and at the end those that a worker may send at any time. */
typedef enum {
    ANSWER_RESULT = 'R',
    ANSWER_TROUBLE = 'T', /* of an instance; its failure, but for a step */
    ANSWER_ERROR = 'E',   /* a text: the reason why there is no result */
    ANSWER_LOG = 'L',     /* a message of an FMU */
    ANSWER_FAULT = 'D'    /* the exit status of the process, which ends now; only in Wine */
} Answer;

/* Answers a request inside of the pool, and writes the content of the answer; it refuses those that only
 * a worker answers. The inputs are those of derivatives. */
Answer pool_answer(Pool *pool, Matrix inputs, Request request, Reader *reader, Writer *writer);

/* The answer to a request that is refused. */
Answer answer_refusal(Writer *writer, const char *why);
/* The answer where the instances have done what was asked, unless the request was damaged, or one of them
 * has failed; -1 stands for none. */
Answer answer_after(Pool *pool, const Reader *reader, Writer *writer, ptrdiff_t failed);

#endif
