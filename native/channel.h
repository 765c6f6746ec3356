/* A connection between two processes of one machine, over which packets go. */

#ifndef FMUGYM_CHANNEL_H
#define FMUGYM_CHANNEL_H

#include "packet.h"
#include "platform.h"

typedef struct {
#if defined _WIN32
    HANDLE input, output;
#else
    int socket;
    int without_looks; /* messages for which the process sleeps at once */
#endif
    char *received; /* what has come and was not asked for yet */
    size_t begin, end;
} Channel;

typedef enum { CAME, LATE, GONE } Arrival;

/* Takes over the ends. Returns whether there was enough memory. */
#if defined _WIN32
bool channel_open(Channel *channel, HANDLE input, HANDLE output);
#else
bool channel_open(Channel *channel, int socket);
#endif
void channel_close(Channel *channel);

/* Both wait until a time of clock_now at most; on Windows for ever. After a packet that came late or not at
 * all, the channel is of no use. */
Arrival channel_send(Channel *channel, char code, Packet *packet, uint64_t deadline);
/* A packet that is late may still come: the next call goes on waiting. */
Arrival channel_receive(Channel *channel, char *code, Packet *packet, uint64_t deadline);

#endif
