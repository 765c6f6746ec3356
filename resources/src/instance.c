/* Creation, destruction and reset of instances. */

#include "instance.h"

#include <stdlib.h>
#include <string.h>

#include "log.h"

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

/* The size of a cache line. An instance begins on one, so that a step touches as few as possible. */
enum { LINE = 64 };

static Instance *first_line_of(void *memory) {
    return (Instance *)((char *)memory + (LINE - (uintptr_t)memory % LINE));
}

Instance *instance_create(size_t size, const char *name) {
    if (name == NULL) {
        return NULL;
    }
    const size_t length = strlen(name) + 1;
    void *memory = calloc(1, LINE + size + length); /* the name follows the instance */
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
           "the GUID (instantiation token) must be the FMU's, %s", model_token);
    return false;
}

Status reset(Instance *instance, const char *) {
    if (instance == NULL) {
        return STATUS_ERROR;
    }
    set_start_values(&instance->simulation);
    return STATUS_OK;
}
