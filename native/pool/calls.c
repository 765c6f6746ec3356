/* What a pool does when it is called. */

#include "pool/schedule.h"

#include <stdlib.h>

#include "pool/failures.h"
#include "pool/initial_states.h"
#include "pool/instances.h"
#include "pool/recorded_inputs.h"

size_t pool_step(Pool *pool, const Call *call) {
    Task task = {.pool = pool, .call = call, .operation = STEP};
    return schedule_run(&task, pool->settings.count);
}

size_t pool_reset(Pool *pool, const Call *call) {
    Task task = {.pool = pool, .call = call, .operation = RESET, .listed = true};
    return schedule_run_with_starts(&task, schedule_choose(pool, call->mask));
}

/* Reads variables of one instance into a column of values. */
static Status read_instance(Pool *pool, Instance *me, const Access *access, double *memory,
                            double *column) {
    if (me->phase != PHASE_STEPPING && me->phase != PHASE_ENDED) {
        return instance_refuse(me, "the instance needs a reset before anything can be read");
    }
    const Status status = access_get(access, me->library, me->component, memory,
                                     memory + access->count, &pool->floats);
    if (status > STATUS_WARNING) {
        return instance_fail(pool, me, "reading variables", status);
    }
    for (size_t i = 0; i < access->count; i++) {
        column[i * pool->settings.count] = memory[i];
    }
    return status;
}

ptrdiff_t pool_read(Pool *pool, const Access *access, double *values) {
    double *memory = malloc((access->count + access->width + 1) * sizeof *memory);
    ptrdiff_t failed = -1;

    if (memory == NULL) {
        instance_refuse(&pool->instances[0], "out of memory");
        return 0;
    }
    for (size_t i = 0; i < pool->settings.count && failed < 0; i++) {
        Instance *me = &pool->instances[i];
        if (read_instance(pool, me, access, memory, values + i) > STATUS_WARNING) {
            failed = (ptrdiff_t)i;
        }
    }
    free(memory);
    return failed;
}

/* Sets variables of one instance from a column of values. A record without them is of no use. */
static Status write_instance(Pool *pool, Instance *me, const Access *access, double *memory,
                             const double *column) {
    if (me->phase != PHASE_STEPPING) {
        return instance_refuse(me, "the instance needs a reset before anything can be set");
    }
    for (size_t i = 0; i < access->count; i++) {
        memory[i] = column[i * pool->settings.count];
    }
    record_drop(pool, index_of(pool, me));
    const Status status = access_set(access, me->library, me->component, memory,
                                     memory + access->count, &pool->floats);
    return status > STATUS_WARNING ? instance_fail(pool, me, "setting variables", status) : status;
}

ptrdiff_t pool_write(Pool *pool, const Access *access, const double *values) {
    double *memory = malloc((access->count + access->width + 1) * sizeof *memory);
    ptrdiff_t failed = -1;

    if (memory == NULL) {
        instance_refuse(&pool->instances[0], "out of memory");
        return 0;
    }
    for (size_t i = 0; i < pool->settings.count && failed < 0; i++) {
        Instance *me = &pool->instances[i];
        if (write_instance(pool, me, access, memory, values + i) > STATUS_WARNING) {
            failed = (ptrdiff_t)i;
        }
    }
    free(memory);
    return failed;
}

size_t pool_restore(Pool *pool, const State *states, const Snapshot *snapshot, size_t count) {
    const Call call = {.turn = NULL};
    Task task = {.pool = pool,
                 .call = &call,
                 .operation = RESTORE,
                 .states = states,
                 .snapshot = snapshot,
                 .listed = true};

    pool->no_return = false;
    return schedule_run(&task, count);
}
