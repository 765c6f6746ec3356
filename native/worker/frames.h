/* Messages between a worker and the process that has started it.
 *
 * A message is a head of two numbers, a code and a size, and a content of this size: a form, see
 * ../form.h. fmugym/pool/process/channel.py is the other end. */

#ifndef FMUGYM_FRAMES_H
#define FMUGYM_FRAMES_H

#include "../form.h"
#include "../platform.h"

/* In the order of fmugym/pool/process/requests.py. All requests but a release have one answer. */
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
    REQUEST_ROLL_OUT,
    REQUEST_TEXT_OF,
    REQUEST_CLOSE,
    REQUESTS
} Request;

/* What a worker sends: an answer, or what may come at any time. */
enum {
    ANSWER_FINE = 'F',    /* to a step: no status is worse than a warning */
    ANSWER_TROUBLE = 'T', /* to a step: some are */
    ANSWER_RESULT = 'R',
    ANSWER_ERROR = 'E',   /* why there is no result */
    ANSWER_FAILURE = 'X', /* the same, where an instance has failed */
    MESSAGE_OF_FMU = 'L',
    MESSAGE_OF_FAULT = 'D' /* the exit status of the process, which ends now; only in Wine */
};

/* One end of a connection: on Windows the handles of a stream to read and of another one to write, or
 * both those of a socket; elsewhere the descriptor of a socket. */
typedef struct {
#if defined _WIN32
    void *input, *output;
    bool is_socket;
#else
    int socket;
#endif
    const Atomic *bell; /* a count in shared memory that the other end raises after each message; NULL
                         * before it is known */
    uint64_t heard;     /* messages received, in the numbers of the bell */
} Channel;

/* Whether the connection is there: an FMU may have closed it. */
bool channel_is_open(const Channel *channel);

typedef struct {
    uint64_t code, size;
} Head;

/* Return whether it worked; the other end may be gone. Waiting for a head watches the bell for a
 * short time before it goes to sleep. */
bool receive_head(Channel *channel, Head *head);
bool receive_content(Channel *channel, char *bytes, size_t size);
bool send_message(Channel *channel, uint64_t code, const void *content, size_t size);

/* A form that grows; the caller frees the bytes. */
typedef struct {
    char *bytes;
    size_t size, room;
} Writer;

/* As realloc; if memory runs out, the process ends, which its parent takes as a death. */
void *memory_for(void *old, size_t size);

void write_integer(Writer *writer, int64_t number);
void write_number(Writer *writer, double number);
void write_text(Writer *writer, const char *text); /* NULL counts as empty */
void write_block(Writer *writer, const void *bytes, size_t size);
/* Makes room for a block, which the caller fills. It stays there until the next call. */
char *write_room(Writer *writer, size_t size);

#endif
