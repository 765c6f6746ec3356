#include "bundles.h"

#include <stdlib.h>
#include <string.h>

#include "failures.h"
#include "instances.h"
#include "records.h"
#include "steps.h"

static const size_t SPARES_LIMIT = (size_t)64 << 20; /* bytes of states kept for reuse, in all */

/* Saving */

/* Overwrites the last state of the instance, as FMI allows. An FMU that makes a new state instead
 * would leak memory, so its states are freed from then on. */
static Status save_over(Pool *pool, Instance *me, void **spare) {
    void *before = *spare;
    const Status status = pool->settings.fmi->get_state(me->library, me->component, spare);

    floats_restore_if_seen(&pool->floats);
    if (before != NULL && *spare != before) {
        atomic_set(&pool->wasteful, 1);
    }
    return status > STATUS_WARNING ? instance_fail(pool, me, "saving the FMU state", status)
                                   : status;
}

static bool make_room(Bundle *bundle, size_t size) {
    if (bundle->bytes != NULL && bundle->room - bundle->size >= size) {
        return true;
    }
    const size_t room = 2 * bundle->room + size;
    char *bytes = realloc(bundle->bytes, room);

    if (bytes != NULL) {
        bundle->bytes = bytes;
        bundle->room = room;
    }
    return bytes != NULL;
}

static Status append(Pool *pool, Instance *me, void *state, size_t size, Bundle *bundle) {
    if (!make_room(bundle, size)) {
        return instance_refuse(me, "out of memory");
    }
    const Status status = pool->settings.fmi->serialize(me->library, me->component, state,
                                                        bundle->bytes + bundle->size, size);
    floats_restore_if_seen(&pool->floats);
    if (status > STATUS_WARNING) {
        return instance_fail(pool, me, "serializing the FMU state", status);
    }
    bundle->size += size;
    return status;
}

static Status bundle_instance(Pool *pool, Instance *me, Bundle *bundle) {
    void **spare = &pool->spares[index_of(pool, me)];
    Status status = save_over(pool, me, spare);

    if (status > STATUS_WARNING) {
        return status;
    }
    const size_t size = pool->settings.fmi->state_size(me->library, me->component, *spare);
    floats_restore_if_seen(&pool->floats);
    status = size == 0 ? instance_refuse(me, "the FMU state has no bytes")
                       : append(pool, me, *spare, size, bundle);
    if (size > SPARES_LIMIT / pool->settings.count || atomic_get(&pool->wasteful)) {
        instance_free_state(pool, me, spare);
    }
    return status;
}

ptrdiff_t pool_bundle(Pool *pool, const int64_t *indices, size_t count, Bundle *bundle,
                      int64_t *ends, int64_t *steps, double *start_times) {
    pool->no_return = false;
    for (size_t i = 0; i < count; i++) {
        Instance *me = &pool->instances[indices[i]];
        if (me->phase == PHASE_STEPPING && bundle_instance(pool, me, bundle) > STATUS_WARNING) {
            return (ptrdiff_t)indices[i];
        }
        steps[i] = me->steps;
        start_times[i] = me->start_time;
        ends[i] = (int64_t)bundle->size;
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

static void put_outputs(const Pool *pool, size_t index, const States *states, size_t number) {
    const Settings *s = &pool->settings;

    for (size_t i = 0; i < s->outputs->count; i++) {
        s->output_values[i * s->count + index] = states->outputs[i * states->count + number];
    }
}

Status instance_unbundle(Pool *pool, Instance *me, const States *states, size_t number) {
    const size_t index = index_of(pool, me);
    const int64_t begin = number == 0 ? 0 : states->ends[number - 1];
    const size_t size = (size_t)(states->ends[number] - begin);
    Status status = STATUS_OK;

    health_count_steps(pool, me);
    record_drop(pool, index);
    put_outputs(pool, index, states, number);
    if (size == 0) { /* its episode had ended by a fault */
        me->phase = me->phase == PHASE_STEPPING ? PHASE_ENDED : me->phase;
        return STATUS_OK;
    }
    if (me->phase == PHASE_DEAD) {
        status = instance_return_to_start(pool, me);
    }
    if (status <= STATUS_WARNING) {
        status = set_state(pool, me, states->bytes + begin, size);
    }
    me->start_time = states->start_times[number];
    instance_count_from(me, states->steps[number]);
    return status;
}
