/* Requests: what the owner of a pool asks of it besides its steps, as forms. The owner is in this process,
 * or has a worker in another one. fmugym/pool/requests.py writes requests and reads answers. */

#ifndef FMUGYM_REQUESTS_H
#define FMUGYM_REQUESTS_H

#include "form.h"
#include "states.h"
#include "writer.h"

/* In the order of fmugym/pool/requests.py. Workers answer each of them once, but for a release. */
typedef enum {
    REQUEST_OPEN,
    REQUEST_STEP,      /* all instances */
    REQUEST_STEP_SOME, /* those that are not in the mask */
    REQUEST_RESET,
    REQUEST_SAVE,
    REQUEST_RESTORE,
    REQUEST_RELEASE,
    REQUEST_WRITE,
    REQUEST_READ,
    REQUEST_SAVE_STATES,
    REQUEST_RESTORE_STATES,
    REQUEST_COUNT_STEPS,
    REQUEST_FAILURE,
    REQUEST_DIFFERENTIATE,
    REQUEST_CLOSE,
    REQUESTS
} Request;

/* What comes back: an answer, or from a worker what may come at any time. */
typedef enum {
    ANSWER_FINE = 'F',    /* to a step: no status is worse than a warning */
    ANSWER_TROUBLE = 'T', /* to a step: some are */
    ANSWER_RESULT = 'R',
    ANSWER_ERROR = 'E',   /* why there is no result */
    ANSWER_FAILURE = 'X', /* the same, where an instance has failed */
    MESSAGE_OF_FMU = 'L',
    MESSAGE_OF_FAULT = 'D' /* the exit status of the process, which ends now; only in Wine */
} Answer;

/* Answers a request inside of the pool, and writes the content of the answer; it refuses those that only
 * a worker answers. The inputs are those of derivatives. */
Answer pool_answer(Pool *pool, Matrix inputs, Request request, Reader *reader, Writer *writer);

/* The same for a request to restore states, where the owner has them at hand. */
Answer pool_answer_restore(Pool *pool, Reader *reader, Writer *writer, const State *states,
                           size_t count);

/* The answer to a request that is refused. */
Answer answer_refusal(Writer *writer, const char *why);
/* The answer where the instances have done what was asked, unless the request was damaged, or one of them
 * has failed; -1 stands for none. */
Answer answer_after(Pool *pool, const Reader *reader, Writer *writer, ptrdiff_t failed);

#endif
