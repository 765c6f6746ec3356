/* The worker's side of components in a process of their own: it loads the FMU of one component, and
 * does for it what packets ask for. remote.h is the other side. */

#ifndef FMUGYM_SERVED_H
#define FMUGYM_SERVED_H

#include "channel.h"

/* The codes of packets. */
enum {
    /* requests */
    ASK_OPEN = 'O',
    ASK_INSTANTIATE = 'i',
    ASK_CHOOSE_MESSAGES = 'm',
    ASK_INITIALIZE = 'b',
    ASK_STEP = 's',
    ASK_GET = 'g',
    ASK_SET = 'p',
    ASK_SET_STRING = 't',
    ASK_GET_STRING = 'T',
    ASK_RESET = 'r',
    ASK_TERMINATE = 'e',
    ASK_FREE = 'f',
    ASK_GET_STATE = 'S',
    ASK_SET_STATE = 'P',
    ASK_FREE_STATE = 'D',
    ASK_STATE_SIZE = 'z',
    ASK_SERIALIZE = 'w',
    ASK_DESERIALIZE = 'u',
    GO_ON = 'c', /* what the worker has called back for is done */
    /* answers */
    ANSWER = 'R',
    CALL_BACK = 'C', /* in an initialization: for start values, or to exchange values */
    MESSAGE = 'L',   /* of the FMU; at any time */
    FAULT = 'X'      /* an exception of Windows ends the process */
};

enum { CALLED_FOR_STARTS, CALLED_FOR_EXCHANGE };

/* Answers requests until the other side is gone, which ends the process. */
void serve_component(Channel *channel);
#if !defined _WIN32
/* The same over the standard input, which is a socket. What the FMU prints goes to the standard
 * error. Returns only if that is not possible. */
void serve_standard_streams(void);
#endif

#endif
