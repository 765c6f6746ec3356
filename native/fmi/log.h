/* Messages of FMUs. C code formats them and queues them per pool. The calling thread passes them
 * to Python. */

#ifndef FMUGYM_LOG_H
#define FMUGYM_LOG_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "shared/platform.h"

enum {
    LOG_RECENT = 10,
    LOG_QUEUE_LIMIT = 1000,
    LOG_IDLE_LIMIT = 1000 /* messages that nobody wants, until the FMU is asked to log less */
};

typedef struct Message {
    struct Message *next;
    size_t index; /* index of the instance in its pool, times parts, plus that of the part */
    int status;
    char *category;
    char *text;
} Message;

/* The last messages of one instance. The texts of failures include them. */
typedef struct {
    char *texts[LOG_RECENT]; /* a ring; unused places are NULL */
    int statuses[LOG_RECENT];
    size_t next;
} Recent;

/* The receiver of one pool's messages. FMUs identify it by a number, not by a pointer. If an
 * instance outlives its pool, its messages find no receiver and touch no freed memory. */
typedef struct Log {
    struct Log *next;
    uint32_t id;
    size_t count; /* of instances times parts */
    size_t parts; /* of each instance: the FMUs of a system, or 1 */
    Atomic *recent; /* one Recent * per part, 0 until it logs something */
    Message *first, *last;
    size_t queued;
    size_t dropped;
    bool terse;     /* whether messages with the status OK are not queued */
    Atomic pending; /* whether messages are queued */
    Atomic idle;    /* how many messages were not queued because the log is terse */
} Log;

bool log_open(Log *log, size_t count, size_t parts, bool terse);
void log_close(Log *log);

/* The number that identifies the first part of an instance to FMUs: it combines log and instance.
 * Those of the other parts follow. */
uint64_t log_environment(const Log *log, size_t index);
/* Writes a name that tells FMI 1.0 and 2.0 the same, and that no instance of another process has: FMUs name
 * files by it. It is shorter than LOG_NAME bytes. */
enum { LOG_NAME = 160 };
void log_name(char *name, const char *model, uint64_t environment);

/* Takes all queued messages; the caller frees each. Sets dropped to the number that did not fit. */
Message *log_take(Log *log, size_t *dropped);
void message_free(Message *message);
void messages_free(Message *first);
/* Puts messages that were taken back in front of the others. Also adds the number of dropped
 * ones. */
void log_give_back(Log *log, Message *first, size_t dropped);

/* The recent messages of an instance, or NULL if there are none. Each begins with its status as a
 * digit, 9 for an unknown one, and ends with LOG_END. The caller frees them. */
#define LOG_END "\x1e"
/* Stands before such messages at the end of an error. */
#define LOG_SAID "\x1d"
char *log_said(Log *log, size_t index);
/* Queues a message of this package about an instance. */
void log_tell(Log *log, size_t index, const char *text);
/* Whether an instance has logged nothing since it was made or its messages were forgotten. */
bool log_is_silent(const Log *log, size_t index);
void log_forget(Log *log, size_t index);

/* Also writes the end of every later message to this memory, one line each. The text stays
 * shorter than size bytes. The FMU continues only after the write, because it may crash the
 * process next. */
void log_echo_to(char *memory, size_t size);

/* Fork. The lock is held during a fork, so that the child finds no unfinished change. */
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
