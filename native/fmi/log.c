/* The logger callbacks of the FMI versions, and the queues behind them.
 *
 * An FMU may log from any thread, including its own threads. One lock guards everything here.
 * Logging is rare, and no thread waits while it holds the lock. */

#include "fmi/log.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { TEXT_SIZE = 4096, INDEX_BITS = 32 };

static Mutex lock = MUTEX_INITIALIZER;
static Log *logs;
static uint32_t next_id = 1;

static struct {
    char *text;
    size_t size; /* 0 without an echo */
    size_t length;
} echo;

bool log_open(Log *log, size_t count, size_t parts, bool terse) {
    memset(log, 0, sizeof *log);
    log->recent = calloc(count * parts, sizeof *log->recent);
    if (log->recent == NULL) {
        return false;
    }
    log->count = count * parts;
    log->parts = parts;
    log->terse = terse;
    mutex_lock(&lock);
    log->id = next_id++;
    log->next = logs;
    logs = log;
    mutex_unlock(&lock);
    return true;
}

static Recent *recent_of(const Log *log, size_t index) {
    return (Recent *)(uintptr_t)atomic_get(&log->recent[index]);
}

static void forget(Log *log, size_t index) {
    Recent *recent = recent_of(log, index);

    for (size_t i = 0; recent != NULL && i < LOG_RECENT; i++) {
        free(recent->texts[i]);
    }
    free(recent);
    atomic_set(&log->recent[index], 0);
}

static void unlink_log(const Log *log) {
    for (Log **link = &logs; *link != NULL; link = &(*link)->next) {
        if (*link == log) {
            *link = log->next;
            return;
        }
    }
}

void log_close(Log *log) {
    size_t dropped;

    mutex_lock(&lock);
    unlink_log(log);
    mutex_unlock(&lock);
    for (size_t i = 0; i < log->count; i++) {
        forget(log, i);
    }
    free((void *)log->recent);
    log->recent = NULL;
    log->count = 0;
    messages_free(log_take(log, &dropped));
}

uint64_t log_environment(const Log *log, size_t index) {
    return ((uint64_t)log->id << INDEX_BITS) | (index * log->parts);
}

void log_name(char *name, const char *model, uint64_t environment) {
    snprintf(name, LOG_NAME, "%.110s_%u_%u_%u", model, (unsigned)number_of_process(),
             (unsigned)(environment >> INDEX_BITS), (unsigned)(environment & UINT32_MAX));
}

void message_free(Message *message) {
    free(message->category);
    free(message->text);
    free(message);
}

void messages_free(Message *first) {
    for (Message *message = first, *next; message != NULL; message = next) {
        next = message->next;
        message_free(message);
    }
}

void log_give_back(Log *log, Message *first, size_t dropped) {
    Message *last = first;

    mutex_lock(&lock);
    log->queued += first != NULL;
    while (last != NULL && last->next != NULL) {
        last = last->next;
        log->queued++;
    }
    if (last != NULL) {
        last->next = log->first;
        log->last = log->first == NULL ? last : log->last;
        log->first = first;
    }
    log->dropped += dropped;
    atomic_set(&log->pending, log->first != NULL || log->dropped > 0);
    mutex_unlock(&lock);
}

Message *log_take(Log *log, size_t *dropped) {
    mutex_lock(&lock);
    Message *first = log->first;
    *dropped = log->dropped;
    log->first = log->last = NULL;
    log->queued = log->dropped = 0;
    atomic_set(&log->pending, 0);
    mutex_unlock(&lock);
    return first;
}

static char *duplicate(const char *text) {
    const size_t size = strlen(text) + 1;
    char *copy = malloc(size);
    if (copy != NULL) {
        memcpy(copy, text, size);
    }
    return copy;
}

/* Receiving messages. Functions without a lock of their own expect the caller to hold it. A message
 * is lost if there is no memory for it. */

static void enqueue(Log *log, Message *message) {
    if (log->first == NULL) {
        log->first = message;
    } else {
        log->last->next = message;
    }
    log->last = message;
    log->queued++;
}

static void queue_message(Log *log, size_t index, int status, const char *category,
                          const char *text) {
    Message *message = log->queued < LOG_QUEUE_LIMIT ? calloc(1, sizeof *message) : NULL;

    atomic_set(&log->pending, 1);
    if (message == NULL) {
        log->dropped++;
        return;
    }
    message->index = index;
    message->status = status;
    message->category = duplicate(category);
    message->text = duplicate(text);
    enqueue(log, message);
}

static void remember(Log *log, size_t index, int status, const char *text) {
    Recent *recent = recent_of(log, index);

    if (recent == NULL) {
        recent = calloc(1, sizeof *recent);
        atomic_set(&log->recent[index], (uintptr_t)recent);
    }
    if (recent != NULL) {
        free(recent->texts[recent->next]);
        recent->texts[recent->next] = duplicate(text);
        recent->statuses[recent->next] = status;
        recent->next = (recent->next + 1) % LOG_RECENT;
    }
}

static Log *find_log(uint32_t id) {
    Log *log = logs;
    while (log != NULL && log->id != id) {
        log = log->next;
    }
    return log;
}

void log_echo_to(char *memory, size_t size) {
    mutex_lock(&lock);
    echo.text = memory;
    echo.size = size;
    echo.length = 0;
    mutex_unlock(&lock);
}

/* Drops as much of the beginning as the new line needs. Only the end of a line that is too long
 * stays. */
static void append_to_echo(const char *category, const char *text) {
    char room[TEXT_SIZE + 64];
    const char *line = room;

    if (echo.size < 2) {
        return;
    }
    snprintf(room, sizeof room, "[%.32s] %s", category, text);
    size_t length = strlen(line);
    if (length > echo.size - 2) {
        line += length - (echo.size - 2);
        length = echo.size - 2;
    }
    const size_t free_bytes = echo.size - 1 - echo.length;
    const size_t dropped = length + 1 > free_bytes ? length + 1 - free_bytes : 0;
    memmove(echo.text, echo.text + dropped, echo.length - dropped);
    echo.length -= dropped;
    memcpy(echo.text + echo.length, line, length);
    echo.length += length;
    echo.text[echo.length++] = '\n';
    echo.text[echo.length] = '\0';
}

static void trim_end(char *text) {
    size_t length = strlen(text);
    while (length > 0 && strchr(" \t\r\n", text[length - 1]) != NULL) {
        text[--length] = '\0';
    }
}

static void keep(uint64_t environment, int status, const char *category, const char *text) {
    const size_t index = (size_t)(environment & UINT32_MAX);

    append_to_echo(category, text);
    Log *log = find_log((uint32_t)(environment >> INDEX_BITS));
    if (log != NULL && index < log->count) {
        remember(log, index, status, text);
        if (log->terse && status == 0) {
            atomic_add(&log->idle, 1);
        } else {
            queue_message(log, index, status, category, text);
        }
    }
}

/* The text loses blanks at its end. */
static void deliver(uint64_t environment, int status, const char *category, char *text) {
    category = category == NULL ? "" : category;
    trim_end(text);
    mutex_lock(&lock);
    keep(environment, status, category, text);
    mutex_unlock(&lock);
}

void log_tell(Log *log, size_t index, const char *text) {
    mutex_lock(&lock);
    queue_message(log, index * log->parts, 1, "fmugym", text);
    mutex_unlock(&lock);
}

/* Recent messages */

static size_t size_of(const Recent *recent) {
    size_t size = 0;
    for (size_t i = 0; i < LOG_RECENT && recent != NULL; i++) {
        size += recent->texts[i] == NULL ? 0 : strlen(recent->texts[i]) + 2;
    }
    return size;
}

/* Returns the end of the text. */
static char *append_recent(char *end, const Recent *recent) {
    for (size_t i = 0; i < LOG_RECENT && recent != NULL; i++) {
        const size_t place = (recent->next + i) % LOG_RECENT;
        const int status = recent->statuses[place];
        if (recent->texts[place] != NULL) {
            *end++ = (char)('0' + (status < 0 || status > 9 ? 9 : status));
            end += sprintf(end, "%s" LOG_END, recent->texts[place]);
        }
    }
    return end;
}

static char *join(const Log *log, size_t first) {
    size_t size = 1;
    for (size_t i = 0; i < log->parts; i++) {
        size += size_of(recent_of(log, first + i));
    }
    char *joined = size == 1 ? NULL : calloc(1, size);
    char *end = joined;
    for (size_t i = 0; i < log->parts && joined != NULL; i++) {
        end = append_recent(end, recent_of(log, first + i));
    }
    return joined;
}

char *log_said(Log *log, size_t index) {
    mutex_lock(&lock);
    char *said = join(log, index * log->parts);
    mutex_unlock(&lock);
    return said;
}

bool log_is_silent(const Log *log, size_t index) {
    bool silent = true;
    for (size_t i = 0; i < log->parts; i++) {
        silent &= atomic_get(&log->recent[index * log->parts + i]) == 0;
    }
    return silent;
}

void log_forget(Log *log, size_t index) {
    mutex_lock(&lock);
    for (size_t i = 0; i < log->parts; i++) {
        forget(log, index * log->parts + i);
    }
    mutex_unlock(&lock);
}

/* Fork */

void log_before_fork(void) {
    mutex_lock(&lock);
}

void log_after_fork_in_parent(void) {
    mutex_unlock(&lock);
}

void log_after_fork_in_child(void) {
    mutex_reset(&lock);
}

/* Callbacks. FMI 1.0 and 2.0 identify the instance by its name. The name ends in the numbers of
 * the log and of the instance, "..._12_3". FMI 1.0 offers no other way, and some FMUs of FMI 2.0
 * pass a wrong environment. */

static uint64_t environment_of(const char *name) {
    const char *last = name == NULL ? NULL : strrchr(name, '_');
    const char *first = last;

    while (first != NULL && first > name && *(first - 1) != '_') {
        first--;
    }
    if (first == NULL || first == name) {
        return 0; /* no log has the number 0 */
    }
    const uint64_t id = strtoul(first, NULL, 10);
    return (id << INDEX_BITS) | (uint32_t)strtoul(last + 1, NULL, 10);
}

static void format_and_deliver(const char *name, int status, const char *category,
                               const char *format, va_list arguments) {
    char text[TEXT_SIZE] = "";

    if (format != NULL) {
        vsnprintf(text, sizeof text, format, arguments);
    }
    deliver(environment_of(name), status, category, text);
}

void log_message_fmi1(void *component, const char *name, int status, const char *category,
                      const char *format, ...) {
    va_list arguments;

    (void)component;
    va_start(arguments, format);
    format_and_deliver(name, status, category, format, arguments);
    va_end(arguments);
}

void log_message_fmi2(void *environment, const char *name, int status, const char *category,
                      const char *format, ...) {
    va_list arguments;

    (void)environment;
    va_start(arguments, format);
    format_and_deliver(name, status, category, format, arguments);
    va_end(arguments);
}

void log_message_fmi3(void *environment, int status, const char *category, const char *text) {
    char copy[TEXT_SIZE];

    snprintf(copy, sizeof copy, "%s", text == NULL ? "" : text);
    deliver((uint64_t)(uintptr_t)environment, status, category, copy);
}
