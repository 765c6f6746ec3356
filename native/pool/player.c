/* Calls of a pool with programs around its steps. */

#include "pool/player.h"

#include <string.h>

#include "pool/schedule.h"

static void tell_ends(Task *task, Ends *ends) {
    ends->ended = (size_t)atomic_get(&task->ended);
    ends->started = (size_t)atomic_get(&task->started);
    ends->outside = atomic_get(&task->outside) != 0;
}

size_t pool_play(Pool *pool, const Call *call, Ends *ends) {
    Task task = {.pool = pool, .call = call, .operation = PLAY};
    const size_t troubled = schedule_run_with_starts(&task, pool->settings.count);

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
