/* Messages to the importer. */

#include "log.h"

#include <stdarg.h>
#include <stdio.h>
#include <string.h>

static const char *category_of(Status status) {
    return status == STATUS_DISCARD ? "logStatusDiscard" : "logStatusError";
}

Status report(const Instance *instance, Status status, const char *function, const char *format,
              ...) {
    char message[384];
    va_list arguments;

    if (instance->muted & (1u << status)) {
        return status;
    }
    /* The loggers of FMI 1.0 and 2.0 take a format string. A text from the importer may contain a
     * percent sign, so it never becomes part of a message. */
    const int length = snprintf(message, sizeof message, "%s: ", function);
    va_start(arguments, format);
    vsnprintf(message + length, sizeof message - (size_t)length, format, arguments);
    va_end(arguments);
    emit_message(instance, status, category_of(status), message);
    return status;
}

/* Returns the bits of the statuses that the category covers; 0 if the category is unknown. */
static uint32_t bits_of(const char *category) {
    uint32_t bits = 0;
    for (Status status = STATUS_DISCARD; status <= STATUS_ERROR; status++) {
        if (strcmp(category, category_of(status)) == 0 || strcmp(category, "logAll") == 0) {
            bits |= 1u << status;
        }
    }
    return bits;
}

/* Messages that explain a status are no debug messages: they are sent from the start, whatever
 * loggingOn says at instantiation. Only this function mutes them. */
Status set_logging(Instance *instance, const char *function, bool on, size_t number,
                   const char *const categories[]) {
    const uint32_t all = bits_of("logAll");
    uint32_t chosen = number == 0 ? all : 0;

    if (instance == NULL) {
        return STATUS_ERROR;
    }
    for (size_t i = 0; i < number; i++) {
        const uint32_t bits = bits_of(categories[i]);
        if (bits == 0) {
            return report(instance, STATUS_ERROR, function,
                          "log category %zu of the list is unknown", i);
        }
        chosen |= bits;
    }
    instance->muted = on ? all & ~chosen : chosen;
    return STATUS_OK;
}

Status not_supported(const Instance *instance, const char *function) {
    return instance == NULL ? STATUS_ERROR
                            : report(instance, STATUS_ERROR, function, "is not supported");
}

Status no_such_status(const Instance *instance, const char *function) {
    return instance == NULL ? STATUS_ERROR
                            : report(instance, STATUS_DISCARD, function, "no such status exists");
}
