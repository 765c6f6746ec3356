/* A process that runs a component for some of the instances. */

#ifndef FMUGYM_HOST_H
#define FMUGYM_HOST_H

#include "channel.h"

#if !defined _WIN32

#include <sys/types.h>

typedef struct Host {
    struct Host *next; /* of all in this process */
    Mutex lock;        /* held during a request and its answer */
    Channel channel;
    pid_t process; /* 0 if there is none */
    uint64_t generation; /* how many have ended */
    int deaths;          /* in a row */
    const char *label;   /* names the component */
    const char *fate;    /* the same with the end of the last process, or NULL */
    double call_timeout;
    int64_t fault; /* an error of Windows, or -1 */
    Packet out, in;
} Host;

enum { PATIENT = 10 }; /* how many time-outs an initialization may take */

void host_open(Host *host, const char *label, double call_timeout);
/* Ends the process in an orderly way: the first function asks for it, and the second waits. */
void host_begin_closing(Host *host);
void host_close(Host *host);

/* Starts a process if there is none. The caller has the lock of this and all that follow. Returns
 * whether there is one now; if not, error says why. */
bool host_start(Host *host, const char *const *command, const char *const *environment,
                char *error, size_t size);
/* Sends the packet, and waits for the answer while it passes on messages. If the process has ended or
 * takes too long, returns false, and the process is gone. */
bool host_ask(Host *host, char code, int patience, char *answer);
/* Ends a process that is of no use. */
void host_end(Host *host);
/* Notes that the process is of use. */
void host_praise(Host *host);

#endif

#endif
