/* Frames of the worker's protocol: requests and answers over its channel. */

#include "worker/frames.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if !defined _WIN32
#include <errno.h>
#include <sched.h>
#include <sys/socket.h>
#include <sys/stat.h>
#endif

enum {
    LONGEST_WATCH = 40000, /* ns before this process goes to sleep; as in channel.py */
    PAUSES = 16            /* looks before others may have the processor */
};

static const size_t LARGEST_PIECE = 1 << 20; /* bytes in a call of the system */

#if defined _WIN32

bool channel_is_open(const Channel *channel) {
    (void)channel;
    return true;
}

static void give_way(void) {
    SwitchToThread();
}

/* How many bytes a call of the system has moved, which goes on in the background with a socket. */
static size_t moved(HANDLE handle, BOOL done, DWORD count, OVERLAPPED *background) {
    if (background == NULL) {
        return done ? count : 0;
    }
    const bool begun = done || GetLastError() == ERROR_IO_PENDING;
    return begun && GetOverlappedResult(handle, background, &count, TRUE) ? count : 0;
}

/* Return how many bytes, none if the other end is gone. */
static size_t receive_some(const Channel *c, char *bytes, size_t size) {
    OVERLAPPED own = {.hEvent = NULL}, *background = c->is_socket ? &own : NULL;
    DWORD count = 0;
    const BOOL done = ReadFile(c->input, bytes, (DWORD)size, &count, background);
    return moved(c->input, done, count, background);
}

static size_t send_some(const Channel *c, const char *bytes, size_t size) {
    OVERLAPPED own = {.hEvent = NULL}, *background = c->is_socket ? &own : NULL;
    DWORD count = 0;
    const BOOL done = WriteFile(c->output, bytes, (DWORD)size, &count, background);
    return moved(c->output, done, count, background);
}

#else

#if !defined MSG_NOSIGNAL
#define MSG_NOSIGNAL 0
#endif

bool channel_is_open(const Channel *channel) {
    struct stat unused;
    return fstat(channel->socket, &unused) == 0;
}

static void give_way(void) {
    sched_yield();
}

static size_t receive_some(const Channel *c, char *bytes, size_t size) {
    ssize_t count;

    do {
        count = recv(c->socket, bytes, size, 0);
    } while (count < 0 && errno == EINTR);
    return count < 0 ? 0 : (size_t)count;
}

static size_t send_some(const Channel *c, const char *bytes, size_t size) {
    ssize_t count;

    do {
        count = send(c->socket, bytes, size, MSG_NOSIGNAL);
    } while (count < 0 && errno == EINTR);
    return count < 0 ? 0 : (size_t)count;
}

#endif

static size_t piece_of(size_t size) {
    return size < LARGEST_PIECE ? size : LARGEST_PIECE;
}

bool receive_content(Channel *channel, char *bytes, size_t size) {
    while (size > 0) {
        const size_t received = receive_some(channel, bytes, piece_of(size));
        if (received == 0) {
            return false;
        }
        bytes += received;
        size -= received;
    }
    return true;
}

static bool send_all(const Channel *channel, const char *bytes, size_t size) {
    while (size > 0) {
        const size_t sent = send_some(channel, bytes, piece_of(size));
        if (sent == 0) {
            return false;
        }
        bytes += sent;
        size -= sent;
    }
    return true;
}

static bool is_announced(const Channel *channel) {
    for (int i = 0; i < PAUSES; i++) {
        if (atomic_get(channel->bell) > channel->heard) {
            return true;
        }
        spin_pause();
    }
    return false;
}

/* Waking a process on an idle processor takes tens of microseconds. */
static void watch_bell(const Channel *channel) {
    const uint64_t deadline = clock_now() + LONGEST_WATCH;

    while (!is_announced(channel) && clock_now() < deadline) {
        give_way();
    }
}

bool receive_head(Channel *channel, Head *head) {
    if (channel->bell != NULL) {
        watch_bell(channel);
    }
    channel->heard++;
    return receive_content(channel, (char *)head, sizeof *head);
}

bool send_message(Channel *channel, uint64_t code, const void *content, size_t size) {
    const Head head = {code, size};

    if (size == 0) {
        return send_all(channel, (const char *)&head, sizeof head);
    }
    char *whole = memory_for(NULL, sizeof head + size); /* the other end wakes up once */
    memcpy(whole, &head, sizeof head);
    memcpy(whole + sizeof head, content, size);
    const bool sent = send_all(channel, whole, sizeof head + size);
    free(whole);
    return sent;
}

void end_without_memory(void) {
    fprintf(stderr, "the worker has no memory left\n");
    fflush(stderr);
    _Exit(1);
}

void *memory_for(void *old, size_t size) {
    void *memory = realloc(old, size + 1);

    if (memory == NULL) {
        end_without_memory();
    }
    return memory;
}
