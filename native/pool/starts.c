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

size_t start_instance(Task *task, size_t index, Scratch scratch) {
    Pool *pool = task->pool;
    const Call *call = task->call;

    if (call->turn != NULL) {
        play_draw(call->turn, index);
    }
    return note_status(task, index, instance_reset(pool, &pool->instances[index], call, scratch));
}

/* Returns whether the observation of an episode that starts is finite. */
static bool write_first_observation(const Task *task, size_t index) {
    if (task->call->observations == NULL) {
        return true;
    }
    write_observation(task->pool, index, task->call->observations);
    return has_finite_observation(task, index);
}

size_t start_episodes(Task *task, const uint32_t *starting, size_t count, Scratch scratch) {
    bool troubled[RUN];
    size_t number = 0;

    for (size_t j = 0; j < count; j++) {
        troubled[j] = start_instance(task, starting[j], scratch) > 0;
    }
    play_start_episodes(task->call->turn, starting, count);
    for (size_t j = 0; j < count; j++) {
        task->call->turn->play->ended[starting[j]] = 0;
        number += !write_first_observation(task, starting[j]) || troubled[j];
    }
    return number;
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

/* Lists the environments of a run whose next episodes start at once, and notes that they do. */
static void list_restarting(const Task *task, const PlayedRun *run, Listed *starting) {
    starting->count = 0;
    for (size_t index = run->begin; index < run->begin + run->count; index++) {
        const bool starts = has_ended_well(task, run, index);
        task->call->turn->started[index] = starts;
        if (starts) {
            starting->places[starting->count++] = (uint32_t)index;
        }
    }
}

size_t starts_after_ends(Task *task, PlayedRun run, Scratch scratch, size_t *started) {
    const Turn *turn = task->call->turn;
    Listed starting;

    list_restarting(task, &run, &starting);
    for (size_t j = 0; j < starting.count; j++) {
        keep_last(task, starting.places[j]);
    }
    const size_t troubled = start_episodes(task, starting.places, starting.count, scratch);
    for (size_t j = 0; j < starting.count; j++) {
        play_observe(turn, starting.places[j], 1, run.scratch, run.verdict);
    }
    *started += starting.count;
    return troubled;
}
