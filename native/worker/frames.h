/* Messages between a worker and the process that has started it.
 *
 * A message is a head of two numbers, a code and a size, and a content of this size: a form, see
 * forms/form.h. fmugym/pool/processes/channel.py is the other end. */

#ifndef FMUGYM_FRAMES_H
#define FMUGYM_FRAMES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "shared/platform.h"

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

/* As realloc; if memory runs out, the process ends, which its parent takes as a death. */
void *memory_for(void *old, size_t size);
void end_without_memory(void);

#endif
