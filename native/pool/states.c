/* States of instances as bytes, which fit any instance of the same FMU. */

#include "pool/states.h"

#include <stdlib.h>
#include <string.h>

#include "pool/failures.h"
#include "pool/instances.h"
#include "pool/recorded_inputs.h"
#include "pool/steps.h"

/* Saving */

static size_t size_of_outputs(const Pool *pool) {
    return pool->settings.outputs->count * sizeof(double);
}

/* Adds a head and the outputs. Returns the bytes of the rest, or NULL if memory runs out. */
static char *add_state(const Pool *pool, size_t index, StateHead head, size_t rest,
                       Writer *writer) {
    const Settings *s = &pool->settings;
    char *to = write_room(writer, sizeof head + size_of_outputs(pool) + rest);

    if (to == NULL) {
        return NULL;
    }
    memcpy(to, &head, sizeof head);
    to += sizeof head;
    for (size_t i = 0; i < s->outputs->count; i++, to += sizeof(double)) {
        memcpy(to, &s->output_values[i * s->count + index], sizeof(double));
    }
    return to;
}

static Status save_record(Pool *pool, Instance *me, StateHead head, Writer *writer) {
    const size_t index = index_of(pool, me);

    if (!record_is_whole(pool, index)) {
        return instance_refuse(me, "the episode cannot be saved: its inputs are not all known. "
                                   "Either it is too long, or it began before they were kept");
    }
    head.kind = KIND_RECORD;
    const size_t size = record_size(pool, index, &head.starts, &head.rows);
    char *to = add_state(pool, index, head, size, writer);
    if (to == NULL) {
        return instance_refuse(me, "out of memory");
    }
    record_write(pool, index, to);
    return STATUS_OK;
}

static Status serialize(Pool *pool, Instance *me, void *state, StateHead head, Writer *writer) {
    const Fmi *fmi = pool->settings.fmi;
    const size_t size = fmi->state_size(me->library, me->component, state);

    floats_restore_if_seen(&pool->floats);
    if (size == 0) {
        return instance_refuse(me, "the FMU state has no bytes");
    }
    head.kind = KIND_STATE;
    char *to = add_state(pool, index_of(pool, me), head, size, writer);
    if (to == NULL) {
        return instance_refuse(me, "out of memory");
    }
    const Status status = fmi->serialize(me->library, me->component, state, to, size);
    floats_restore_if_seen(&pool->floats);
    return status > STATUS_WARNING ? instance_fail(pool, me, "serializing the FMU state", status)
                                   : status;
}

static Status save_state(Pool *pool, Instance *me, StateHead head, Writer *writer) {
    void *state;
    Status status = instance_save(pool, me, &state);

    if (status <= STATUS_WARNING) {
        status = serialize(pool, me, state, head, writer);
        instance_free_state(pool, me, &state);
    }
    return status;
}

static bool serializes(const Pool *pool) {
    return pool->settings.can_save && pool->settings.fmi->serialize != NULL;
}

static Status save_instance(Pool *pool, Instance *me, bool records, Writer *writer) {
    const size_t index = index_of(pool, me);
    const StateHead head = {KIND_ENDED, me->steps, me->start_time, 0, 0};
    const bool goes_on = records ? pool->settings.status[index] <= STATUS_WARNING
                                 : me->phase == PHASE_STEPPING;

    if (!goes_on) {
        return add_state(pool, index, head, 0, writer) == NULL ? instance_refuse(me, "out of memory")
                                                            : STATUS_OK;
    }
    if (records) {
        return save_record(pool, me, head, writer);
    }
    return serializes(pool) ? save_state(pool, me, head, writer)
                            : instance_refuse(me, "the FMU cannot serialize its state");
}

ptrdiff_t pool_save_states(Pool *pool, const int64_t *indices, size_t count, bool records,
                           Writer *writer) {
    pool->no_return = false;
    for (size_t i = 0; i < count; i++) {
        Instance *me = &pool->instances[indices[i]];
        if (save_instance(pool, me, records, writer) > STATUS_WARNING) {
            return (ptrdiff_t)indices[i];
        }
    }
    return -1;
}

/* Restoring */

static Status set_state(Pool *pool, Instance *me, const char *bytes, size_t size) {
    const Fmi *fmi = pool->settings.fmi;
    void *state = NULL;
    Status status = fmi->deserialize(me->library, me->component, bytes, size, &state);

    floats_restore_if_seen(&pool->floats);
    if (status > STATUS_WARNING) {
        return instance_fail(pool, me, "reading a serialized FMU state", status);
    }
    status = instance_restore(pool, me, state);
    instance_free_state(pool, me, &state);
    return status;
}

static StateHead head_of(State state) {
    StateHead head;

    memcpy(&head, state.bytes, sizeof head);
    return head;
}

bool state_is_sound(const Pool *pool, State state) {
    const size_t before = sizeof(StateHead) + size_of_outputs(pool);

    if (state.size < before) {
        return false;
    }
    const StateHead head = head_of(state);
    const size_t rest = state.size - before;
    return head.kind == KIND_ENDED    ? rest == 0
           : head.kind == KIND_STATE  ? rest > 0 && serializes(pool)
           : head.kind == KIND_RECORD ? record_fits(pool, head.starts, head.rows,
                                                   state.bytes + before, rest)
                                      : false;
}

static void put_outputs(const Pool *pool, size_t index, const char *from) {
    const Settings *s = &pool->settings;

    for (size_t i = 0; i < s->outputs->count; i++, from += sizeof(double)) {
        memcpy(&s->output_values[i * s->count + index], from, sizeof(double));
    }
}

static Status restore(Pool *pool, Instance *me, StateHead head, const char *bytes, size_t size) {
    Status status = STATUS_OK;

    health_count_steps(pool, me);
    record_drop(pool, index_of(pool, me));
    if (head.kind == KIND_ENDED) {
        me->phase = me->phase == PHASE_STEPPING ? PHASE_ENDED : me->phase;
        return STATUS_OK;
    }
    if (me->phase == PHASE_DEAD) {
        status = instance_return_to_start(pool, me);
    }
    if (status <= STATUS_WARNING) {
        status = set_state(pool, me, bytes, size);
    }
    me->start_time = head.start_time;
    instance_count_from(me, head.steps);
    return status;
}

Status instance_take_state(Pool *pool, Instance *me, State state) {
    const size_t index = index_of(pool, me), before = sizeof(StateHead) + size_of_outputs(pool);
    const StateHead head = head_of(state);

    put_outputs(pool, index, state.bytes + sizeof head);
    if (head.kind == KIND_RECORD) {
        record_put(pool, index, (size_t)head.starts, (size_t)head.rows, state.bytes + before);
        return (Status)pool->settings.status[index];
    }
    return restore(pool, me, head, state.bytes + before, state.size - before);
}
