/* What a pool does when it is called. */

#include "schedule.h"

#include <stdlib.h>
#include <string.h>

#include "failures.h"
#include "initial_states.h"
#include "instances.h"
#include "recorded_inputs.h"

/* Makes room for wider rows of start values. The values kept so far no longer apply. */
static bool make_room_for_starts(Pool *pool, const Access *start) {
    const size_t count = pool->settings.count;

    if (start->count <= pool->start_width) {
        return true;
    }
    double *starts = malloc(count * start->count * sizeof *starts);
    if (starts == NULL) {
        return false;
    }
    free(pool->starts);
    pool->starts = starts;
    pool->start_width = start->count;
    memset(pool->start_ids, 0, count * sizeof *pool->start_ids);
    return true;
}

/* The new start values may need more memory than the pool has. */
static size_t run_with_starts(Task *task, size_t count) {
    return make_room_for_starts(task->pool, task->call->start) ? schedule_run(task, count)
                                                               : task_give_up(task, 0, count);
}

size_t pool_step(Pool *pool, const Call *call) {
    Task task = {.pool = pool, .call = call, .operation = STEP};
    return schedule_run(&task, pool->settings.count);
}

size_t pool_reset(Pool *pool, const Call *call) {
    Task task = {.pool = pool, .call = call, .operation = RESET, .listed = true};
    return run_with_starts(&task, schedule_choose(pool, call->mask));
}

static void tell_ends(Task *task, Ends *ends) {
    ends->ended = (size_t)atomic_get(&task->ended);
    ends->started = (size_t)atomic_get(&task->started);
    ends->outside = atomic_get(&task->outside) != 0;
}

size_t pool_play(Pool *pool, const Call *call, Ends *ends) {
    Task task = {.pool = pool, .call = call, .operation = PLAY};
    const size_t troubled = run_with_starts(&task, pool->settings.count);

    tell_ends(&task, ends);
    return troubled;
}

size_t pool_play_before(Pool *pool, const Call *call) {
    Task task = {.pool = pool, .call = call, .operation = BEFORE};
    return schedule_run(&task, pool->settings.count);
}

size_t pool_play_after(Pool *pool, const Call *call, Ends *ends) {
    Task task = {.pool = pool, .call = call, .operation = AFTER};
    const size_t troubled = schedule_run(&task, pool->settings.count);

    tell_ends(&task, ends);
    return troubled;
}

/* Stores the observations of all, as the program makes them. */
static Verdict observe_all(const Pool *pool, const Turn *turn) {
    const size_t end = pool->settings.count;
    PlayScratch registers;
    Verdict verdict = {.ended = 0};

    play_open(turn, &registers);
    for (size_t first = 0; first < end; first += RUN) {
        play_observe(turn, first, length_of_run(first, end), &registers, &verdict);
    }
    return verdict;
}

size_t pool_start(Pool *pool, const Call *call, bool *outside) {
    const size_t troubled = pool_reset(pool, call);

    if (call->observations == NULL) {
        const Verdict verdict = observe_all(pool, call->turn);
        *outside = verdict.outside;
        return troubled + verdict.troubled;
    }
    if (call->mask.data != NULL) {
        write_all_observations(pool, call->observations);
    }
    return troubled;
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
