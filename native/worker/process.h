/* The process of a worker, as the system sees it. */

#ifndef FMUGYM_PROCESS_H
#define FMUGYM_PROCESS_H

#include "worker/frames.h"

/* Opens one end of a connection: the descriptor of a socket, on Windows its handle. */
void channel_open(Channel *channel, long long descriptor);

/* Lets the system end this process with its parent. Returns whether the parent still lives. */
bool process_end_with(long long parent);

/* Lets a process go on that this one traces, and that a signal has stopped, which it gets now. */
void process_let_go(int process, int stopped_by);

#endif
