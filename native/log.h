/* Messages of FMUs: formatted in C, queued per pool, handed to Python by the calling thread. */

#ifndef FMUGYM_LOG_H
#define FMUGYM_LOG_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "platform.h"

enum { LOG_RECENT = 10, LOG_QUEUE_LIMIT = 1000 };

typedef struct Message {
    struct Message *next;
    size_t index; /* of the instance in its pool */
    int status;
    char *category;
    char *text;
} Message;

/* The last messages of one instance, for the text of failures. */
typedef struct {
    char *texts[LOG_RECENT]; /* a ring; unused places are NULL */
    size_t next;
} Recent;

/* The receiver of one pool's messages. FMUs name it by number, never by pointer, so a message of an
 * instance that lives longer than its pool finds nobody instead of freed memory. */
typedef struct Log {
    struct Log *next;
    uint32_t id;
    size_t count;
    Recent **recent; /* one place per instance, NULL as long as it said nothing */
    Message *first, *last;
    size_t queued;
    size_t dropped;
    Atomic pending; /* whether there is anything to drain */
} Log;

bool log_open(Log *log, size_t count);
void log_close(Log *log);

/* The number of an instance for FMUs: log and instance in one. */
uint64_t log_environment(const Log *log, size_t index);

/* Takes all queued messages; the caller frees each. Also tells how many did not fit. */
Message *log_take(Log *log, size_t *dropped);
void message_free(Message *message);
void messages_free(Message *first);
/* Puts messages that were taken, and the number of those that did not fit, before the others. */
void log_give_back(Log *log, Message *first, size_t dropped);

/* The recent messages of an instance joined by " | ", to be freed by the caller; NULL if none. */
char *log_said(Log *log, size_t index);
void log_forget(Log *log, size_t index);

/* From now on the ends of all messages, a line each, are also written to this memory, as a text of
 * less than size bytes, before the FMU goes on: the process may not survive what it does next. */
void log_echo_to(char *memory, size_t size);

/* Fork: the lock is held while it happens, so that the child finds no half-done change. */
void log_before_fork(void);
void log_after_fork_in_parent(void);
void log_after_fork_in_child(void);

/* The callbacks that FMUs get. */
void log_message_fmi1(void *component, const char *name, int status, const char *category,
                      const char *format, ...);
void log_message_fmi2(void *environment, const char *name, int status, const char *category,
                      const char *format, ...);
void log_message_fmi3(void *environment, int status, const char *category, const char *text);

#endif
