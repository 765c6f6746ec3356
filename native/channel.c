#include "channel.h"

#include <stdlib.h>
#include <string.h>

#if !defined _WIN32
#include <errno.h>
#include <poll.h>
#include <sched.h>
#include <sys/socket.h>
#include <unistd.h>
#endif

enum { ROOM = 1 << 16 };

static bool make_room(Channel *channel) {
    channel->received = malloc(ROOM);
    channel->begin = channel->end = 0;
    return channel->received != NULL;
}

/* send_some and receive_some return how many bytes went through, and 0 if the arrival is not CAME. */

#if defined _WIN32

bool channel_open(Channel *channel, HANDLE input, HANDLE output) {
    channel->input = input;
    channel->output = output;
    return make_room(channel) && input != NULL && output != NULL;
}

void channel_close(Channel *channel) {
    CloseHandle(channel->input);
    CloseHandle(channel->output);
    free(channel->received);
    channel->received = NULL;
}

static size_t send_some(Channel *channel, const char *bytes, size_t size, uint64_t deadline,
                        Arrival *arrival) {
    const DWORD wanted = size > ROOM ? ROOM : (DWORD)size;
    DWORD sent = 0;

    (void)deadline;
    *arrival = WriteFile(channel->output, bytes, wanted, &sent, NULL) && sent > 0 ? CAME : GONE;
    return sent;
}

static size_t receive_some(Channel *channel, char *bytes, size_t size, uint64_t deadline,
                           Arrival *arrival) {
    const DWORD wanted = size > ROOM ? ROOM : (DWORD)size;
    DWORD received = 0;

    (void)deadline;
    *arrival =
        ReadFile(channel->input, bytes, wanted, &received, NULL) && received > 0 ? CAME : GONE;
    return received;
}

#else

bool channel_open(Channel *channel, int socket) {
#if defined SO_NOSIGPIPE
    const int yes = 1;
    setsockopt(socket, SOL_SOCKET, SO_NOSIGPIPE, &yes, sizeof yes);
#endif
    channel->socket = socket;
    channel->without_looks = 0;
    return make_room(channel);
}

void channel_close(Channel *channel) {
    close(channel->socket);
    free(channel->received);
    channel->received = NULL;
}

#if !defined MSG_NOSIGNAL
#define MSG_NOSIGNAL 0
#endif

/* To be woken takes microseconds, so a process looks so often before it goes to sleep, and lets others
 * run in between. On a busy machine this may take milliseconds: then it sleeps at once for the next
 * messages. */
enum { LOOKS = 40, LONGEST_LOOK = 50000 /* ns */, MESSAGES_WITHOUT = 1000 };

/* Returns whether there is time for another look. */
static bool let_others_run(Channel *channel) {
    const uint64_t before = clock_now();

    sched_yield();
    if (clock_now() - before > LONGEST_LOOK) {
        channel->without_looks = MESSAGES_WITHOUT;
    }
    return channel->without_looks == 0;
}

static int looks_for(Channel *channel) {
    channel->without_looks -= channel->without_looks > 0;
    return channel->without_looks > 0 ? 0 : LOOKS;
}

static Arrival wait_for(const Channel *channel, short events, uint64_t deadline) {
    struct pollfd one = {.fd = channel->socket, .events = events};
    const uint64_t now = clock_now();

    if (now >= deadline) {
        return LATE;
    }
    const uint64_t left = (deadline - now) / 1000000 + 1;
    poll(&one, 1, left > 1000000 ? 1000000 : (int)left);
    return CAME;
}

static bool would_wait(void) {
    return errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR;
}

static size_t send_some(Channel *channel, const char *bytes, size_t size, uint64_t deadline,
                        Arrival *arrival) {
    for (*arrival = CAME; *arrival == CAME; *arrival = wait_for(channel, POLLOUT, deadline)) {
        const ssize_t sent = send(channel->socket, bytes, size, MSG_DONTWAIT | MSG_NOSIGNAL);
        if (sent > 0) {
            return (size_t)sent;
        }
        if (!would_wait()) {
            *arrival = GONE;
            return 0;
        }
    }
    return 0;
}

static size_t receive_some(Channel *channel, char *bytes, size_t size, uint64_t deadline,
                           Arrival *arrival) {
    int looks = looks_for(channel);

    for (*arrival = CAME; *arrival == CAME;) {
        const ssize_t received = recv(channel->socket, bytes, size, MSG_DONTWAIT);
        if (received > 0) {
            return (size_t)received;
        }
        if (received == 0 || !would_wait()) {
            *arrival = GONE;
        } else if (looks > 0) {
            looks = let_others_run(channel) ? looks - 1 : 0;
        } else {
            *arrival = wait_for(channel, POLLIN, deadline);
        }
    }
    return 0;
}

#endif

Arrival channel_send(Channel *channel, char code, Packet *packet, uint64_t deadline) {
    const uint64_t content = packet->size - PACKET_HEAD;
    Arrival arrival = packet->sound ? CAME : GONE;

    if (arrival == CAME) {
        packet->bytes[0] = code;
        memcpy(packet->bytes + 1, &content, sizeof content);
    }
    for (size_t at = 0; arrival == CAME && at < packet->size;) {
        at += send_some(channel, packet->bytes + at, packet->size - at, deadline, &arrival);
    }
    return arrival;
}

/* Lets so many bytes stand at the begin of what has come. */
static Arrival gather(Channel *channel, size_t size, uint64_t deadline) {
    Arrival arrival = CAME;

    if (channel->begin > 0 && channel->end - channel->begin < size) {
        memmove(channel->received, channel->received + channel->begin,
                channel->end - channel->begin);
        channel->end -= channel->begin;
        channel->begin = 0;
    }
    while (arrival == CAME && channel->end - channel->begin < size) {
        channel->end += receive_some(channel, channel->received + channel->end,
                                     ROOM - channel->end, deadline, &arrival);
    }
    return arrival;
}

Arrival channel_receive(Channel *channel, char *code, Packet *packet, uint64_t deadline) {
    uint64_t content;
    Arrival arrival = gather(channel, PACKET_HEAD, deadline);

    if (arrival != CAME) {
        return arrival;
    }
    memcpy(&content, channel->received + channel->begin + 1, sizeof content);
    packet_clear(packet);
    if (content > SIZE_MAX / 4 || !packet_resize(packet, PACKET_HEAD + (size_t)content)) {
        return GONE;
    }
    *code = channel->received[channel->begin];
    channel->begin += PACKET_HEAD;
    for (size_t at = PACKET_HEAD; arrival == CAME && at < packet->size;) {
        const size_t there = channel->end - channel->begin, wanted = packet->size - at;
        const size_t size = there < wanted ? there : wanted;
        memcpy(packet->bytes + at, channel->received + channel->begin, size);
        channel->begin += size;
        at += size;
        if (at < packet->size) {
            at += receive_some(channel, packet->bytes + at, packet->size - at, deadline, &arrival);
        }
    }
    return arrival == LATE ? GONE : arrival; /* the rest of a packet does not come alone */
}
