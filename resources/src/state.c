/* An FMU state is a copy of the simulation. Its serialized form is the FMU's token and the copy. */

#include "state.h"

#include <stdlib.h>
#include <string.h>

#include "instance.h"
#include "log.h"

enum { TOKEN_SIZE = 40, SERIALIZED_SIZE = TOKEN_SIZE + sizeof(Simulation) };

static Status store(const Instance *instance, const char *function, const void *simulation,
                    void **state) {
    if (*state == NULL) {
        *state = malloc(sizeof(Simulation));
    }
    if (*state == NULL) {
        return report(instance, STATUS_ERROR, function, "out of memory");
    }
    memcpy(*state, simulation, sizeof(Simulation));
    return STATUS_OK;
}

Status get_state(const Instance *instance, const char *function, void **state) {
    return instance == NULL ? STATUS_ERROR
                            : store(instance, function, &instance->simulation, state);
}

static Status check_state(const Instance *instance, const char *function, const void *state) {
    if (instance == NULL) {
        return STATUS_ERROR;
    }
    return state == NULL ? report(instance, STATUS_ERROR, function, "the FMU state is NULL")
                         : STATUS_OK;
}

Status set_state(Instance *instance, const char *function, const void *state) {
    const Status status = check_state(instance, function, state);
    if (status == STATUS_OK) {
        memcpy(&instance->simulation, state, sizeof(Simulation));
    }
    return status;
}

Status free_state(const Instance *instance, const char *, void **state) {
    if (instance == NULL) {
        return STATUS_ERROR;
    }
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
    return STATUS_OK;
}

Status serialized_size(const Instance *instance, const char *, size_t *size) {
    if (instance == NULL) {
        return STATUS_ERROR;
    }
    *size = SERIALIZED_SIZE;
    return STATUS_OK;
}

Status serialize_state(const Instance *instance, const char *function, const void *state,
                       void *bytes, size_t size) {
    const Status status = check_state(instance, function, state);
    if (status != STATUS_OK) {
        return status;
    }
    if (size < SERIALIZED_SIZE) {
        return report(instance, STATUS_ERROR, function, "a state needs %u bytes, not %u",
                      (unsigned)SERIALIZED_SIZE, (unsigned)size);
    }
    memset(bytes, 0, TOKEN_SIZE);
    memcpy(bytes, model_token, strlen(model_token));
    memcpy((char *)bytes + TOKEN_SIZE, state, sizeof(Simulation));
    return STATUS_OK;
}

Status deserialize_state(const Instance *instance, const char *function, const void *bytes,
                         size_t size, void **state) {
    if (instance == NULL) {
        return STATUS_ERROR;
    }
    if (size < SERIALIZED_SIZE || memcmp(bytes, model_token, strlen(model_token)) != 0) {
        return report(instance, STATUS_ERROR, function,
                      "these bytes are not a serialized state of this FMU");
    }
    return store(instance, function, (const char *)bytes + TOKEN_SIZE, state);
}
