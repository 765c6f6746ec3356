/* Saved states of components in other processes: the worker keeps them, and this process their numbers. */

#include "far.h"

#if !defined _WIN32

#include <stdlib.h>

#include "served.h"

/* What takes the place of an FMU state. */
typedef struct {
    uint64_t generation;
    int64_t number;
} FarState;

static FarState *new_state(const Far *me, int64_t number) {
    FarState *state = malloc(sizeof *state);

    if (state != NULL) {
        *state = (FarState){me->generation, number};
    }
    return state;
}

/* Begins a request about a state. Returns whether the worker still has it. */
static bool begin_with(Far *me, const FarState *state) {
    far_begin(me);
    packet_put_size(&me->host->out, (size_t)state->number);
    return state->generation == me->generation && far_is_alive(me);
}

/* If the FMU makes a new state instead of overwriting the old one, so does this function, and the
 * caller sees it. */
Status far_get_state(const Library *library, void *component, void **state) {
    Far *me = component;
    FarState *old = *state;
    int64_t number = old == NULL || old->generation != me->generation ? -1 : old->number;
    bool other = false;

    (void)library;
    Status status = far_set_waiting(me);
    if (status > STATUS_WARNING) {
        return status;
    }
    far_begin(me);
    PUT(&me->host->out, number);
    status = far_ask(me, ASK_GET_STATE);
    if (status != STATUS_FATAL) {
        TAKE(&me->host->in, number);
        TAKE(&me->host->in, other);
    }
    far_end(me);
    if (other) {
        *state = number < 0 ? NULL : new_state(me, number);
        free(old);
    }
    return *state == NULL && status <= STATUS_WARNING ? STATUS_ERROR : status;
}

Status far_set_state(const Library *library, void *component, void *state) {
    Far *me = component;

    (void)library;
    far_forget_values(me);
    const Status status = begin_with(me, state) ? far_ask(me, ASK_SET_STATE) : STATUS_ERROR;
    far_end(me);
    me->steps = status <= STATUS_WARNING;
    return status;
}

Status far_free_state(const Library *library, void *component, void **state) {
    Far *me = component;

    (void)library;
    const Status status = begin_with(me, *state) ? far_ask(me, ASK_FREE_STATE) : STATUS_OK;
    far_end(me);
    free(*state);
    *state = NULL;
    return status;
}

size_t far_state_size(const Library *library, void *component, void *state) {
    Far *me = component;
    uint64_t size = 0;

    (void)library;
    if (begin_with(me, state) && far_ask(me, ASK_STATE_SIZE) <= STATUS_WARNING) {
        TAKE(&me->host->in, size);
    }
    far_end(me);
    return (size_t)size;
}

Status far_serialize(const Library *library, void *component, void *state, char *bytes,
                        size_t size) {
    Far *me = component;
    const bool own = begin_with(me, state);

    (void)library;
    packet_put_size(&me->host->out, size);
    const Status status = own ? far_ask(me, ASK_SERIALIZE) : STATUS_ERROR;
    if (status <= STATUS_WARNING) {
        packet_take(&me->host->in, bytes, size);
    }
    far_end(me);
    return status;
}

Status far_deserialize(const Library *library, void *component, const char *bytes, size_t size,
                          void **state) {
    Far *me = component;
    int64_t number = -1;

    (void)library;
    far_made_anew(me);
    far_begin(me);
    packet_put_block(&me->host->out, bytes, size);
    const Status status = far_ask(me, ASK_DESERIALIZE);
    if (status != STATUS_FATAL) {
        TAKE(&me->host->in, number);
    }
    far_end(me);
    *state = number < 0 ? NULL : new_state(me, number);
    return *state == NULL && status <= STATUS_WARNING ? STATUS_ERROR : status;
}

#endif
