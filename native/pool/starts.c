/* Starts of episodes: after ended ones in a step, and in a reset. */

#include "pool/starts.h"

#include <math.h>
#include <string.h>

#include "pool/initial_states.h"

static float *observation_of(const Task *task, size_t index) {
    return task->call->observations + index * task->pool->settings.num_observed;
}

/* A finite output may be infinite as a float32. */
static bool has_finite_observation(const Task *task, size_t index) {
    const float *values = observation_of(task, index);
    bool finite = true;

    for (size_t i = 0; i < task->pool->settings.num_observed; i++) {
        finite &= isfinite(values[i]) != 0;
    }
    return finite;
}

size_t starts_one(Task *task, size_t index, Scratch scratch) {
    Pool *pool = task->pool;
    const Call *call = task->call;
    const Play *play = call->turn->play;

    play_draw(call->turn, index);
    const Status status = instance_reset(pool, &pool->instances[index], call, scratch);
    const size_t troubled = note_status(task, index, status);

    play_start_episode(call->turn, index);
    play->ended[index] = 0;
    if (call->observations == NULL) {
        return troubled;
    }
    write_observation(pool, index, call->observations);
    return troubled > 0 || !has_finite_observation(task, index);
}

/* After a fault, the environment stays as it is, so that the caller can say what the fault was. */
static bool has_ended_well(const Task *task, const PlayedRun *run, size_t index) {
    const Turn *turn = task->call->turn;

    return turn->play->ended[index] && task->pool->settings.status[index] <= STATUS_WARNING &&
           !run->verdict->not_finite[index - run->begin] &&
           (task->call->observations == NULL || has_finite_observation(task, index));
}

static void keep_last(const Task *task, size_t index) {
    const Turn *turn = task->call->turn;

    for (size_t i = 0; i < turn->play->number_of_seen; i++) {
        const size_t size = turn->play->array_sizes[i], place = index * size;
        memcpy(turn->last[i] + place, turn->arrays[i] + place, size);
    }
}

size_t starts_after_ends(Task *task, PlayedRun run, Scratch scratch, size_t *started) {
    const Turn *turn = task->call->turn;
    size_t troubled = 0;

    for (size_t index = run.begin; index < run.begin + run.count; index++) {
        turn->started[index] = has_ended_well(task, &run, index);
        if (turn->started[index]) {
            keep_last(task, index);
            troubled += starts_one(task, index, scratch);
            ++*started;
            play_observe(turn, index, 1, run.registers, run.verdict);
        }
    }
    return troubled;
}
