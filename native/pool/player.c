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

void pool_play_before(Pool *pool, const Call *call) {
    Task task = {.pool = pool, .call = call, .operation = BEFORE};
    schedule_run(&task, pool->settings.count);
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
    PlayScratch programs;
    Verdict verdict = {.ended = 0};

    play_open(turn, &programs);
    for (size_t first = 0; first < end; first += RUN) {
        play_observe(turn, first, length_of_run(first, end), &programs, &verdict);
    }
    return verdict;
}

size_t pool_start(Pool *pool, const Call *call, Ends *ends) {
    const Play *play = call->turn->play;
    size_t troubled = pool_reset(pool, call);

    *ends = (Ends){.ended = 0};
    if (call->observations == NULL) {
        const Verdict verdict = observe_all(pool, call->turn);
        ends->outside = verdict.outside;
        troubled += verdict.troubled;
    } else {
        write_all_observations(pool, call->observations);
    }
    for (size_t i = 0; i < play->count; i++) {
        ends->ended += play->ended[i];
    }
    return troubled;
}
