/* Creation, reset and logging of instances. */

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "simulation.h"

#define REAL_START(name, kind, start) start,
#define ENUMERATION_START(name, kind, start, items) start,

static const double real_starts[] = {MODEL_REALS(REAL_START)};
static const int32_t enumeration_starts[] = {MODEL_ENUMERATIONS(ENUMERATION_START)};

static void set_start_values(Simulation *s) {
    memcpy(s->reals.values, real_starts, sizeof real_starts);
    memcpy(s->enumerations, enumeration_starts, sizeof enumeration_starts);
    s->phase = PHASE_INSTANTIATED;
    s->stale = true;
    s->step_status = STATUS_OK;
}

/* A line of the processor's cache. Instances begin with one: a step touches fewer of them then. */
enum { LINE = 64 };

static Instance *first_line_of(void *memory) {
    return (Instance *)((char *)memory + (LINE - (uintptr_t)memory % LINE));
}

Instance *instance_create(size_t size, const char *name) {
    if (name == NULL) {
        return NULL;
    }
    const size_t length = strlen(name) + 1;
    void *memory = calloc(1, LINE + size + length); /* the name lives behind the instance */
    if (memory == NULL) {
        return NULL;
    }
    Instance *instance = first_line_of(memory);
    instance->memory = memory;
    instance->name = memcpy((char *)instance + size, name, length);
    set_start_values(&instance->simulation);
    return instance;
}

void instance_free(Instance *instance) {
    if (instance != NULL) {
        free(instance->memory);
    }
}

bool accepts(const Instance *instance, const char *function, const char *token) {
    if (token != NULL && strcmp(token, model_token) == 0) {
        return true;
    }
    report(instance, STATUS_ERROR, function,
           "the GUID (instantiation token) is not the one of this FMU, %s", model_token);
    return false;
}

Status reset(Instance *instance, const char *function) {
    const Status status = check_phase(instance, function, ANY_PHASE);
    if (status == STATUS_OK) {
        set_start_values(&instance->simulation);
    }
    return status;
}

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
    /* FMI 1.0 and 2.0 loggers take a format: no text of the importer's, which may contain a
     * percent sign, ever enters a message. */
    const int length = snprintf(message, sizeof message, "%s: ", function);
    va_start(arguments, format);
    vsnprintf(message + length, sizeof message - (size_t)length, format, arguments);
    va_end(arguments);
    emit_message(instance, status, category_of(status), message);
    return status;
}

/* Returns the bits of the statuses whose messages the category holds, 0 if it is unknown. */
static uint32_t bits_of(const char *category) {
    uint32_t bits = 0;
    for (Status status = STATUS_DISCARD; status <= STATUS_ERROR; status++) {
        if (strcmp(category, category_of(status)) == 0 || strcmp(category, "logAll") == 0) {
            bits |= 1u << status;
        }
    }
    return bits;
}

/* Messages that explain a status are passed on from the start, whatever loggingOn says at
 * instantiation: they are no debug messages. This function is the way to mute them. */
Status set_logging(Instance *instance, const char *function, bool on, size_t number,
                   const char *const categories[]) {
    const uint32_t all = bits_of("logAll");
    uint32_t chosen = number == 0 ? all : 0;
    const Status status = check_phase(instance, function, ANY_PHASE);

    for (size_t i = 0; status == STATUS_OK && i < number; i++) {
        const uint32_t bits = bits_of(categories[i]);
        if (bits == 0) {
            return report(instance, STATUS_ERROR, function,
                          "log category %zu of the list is not known", i);
        }
        chosen |= bits;
    }
    if (status == STATUS_OK) {
        instance->muted = on ? all & ~chosen : chosen;
    }
    return status;
}

Status not_supported(const Instance *instance, const char *function) {
    const Status status = check_phase(instance, function, ANY_PHASE);
    return status == STATUS_OK ? report(instance, STATUS_ERROR, function, "is not supported")
                               : status;
}

Status no_such_status(const Instance *instance, const char *function) {
    const Status status = check_phase(instance, function, ANY_PHASE);
    return status == STATUS_OK
               ? report(instance, STATUS_DISCARD, function, "there is no such status to ask for")
               : status;
}
