#include "rollouts.h"

#include <string.h>

/* Where a thread is: the task with the arrays of one step. */
typedef struct {
    Task task;
    Call call;
    Turn turn;
    char *seen[MOST_SEEN];
    PlayScratch registers;
    Verdict verdict;
} Position;

static size_t action_bytes(const Play *play) {
    return play->count * play->actions.elements * play->actions.size;
}

static void begin_at_first_step(Position *p, const Task *task) {
    const size_t seen = task->call->turn->play->judgement.number_of_seen;

    p->call = *task->call;
    p->turn = *task->call->turn;
    memcpy(p->seen, p->turn.seen, seen * sizeof *p->seen);
    p->turn.seen = p->seen;
    p->call.turn = &p->turn;
    p->task = (Task){.pool = task->pool,
                     .call = &p->call,
                     .operation = STEP}; /* nothing starts an episode */
}

static void go_to_next_step(Position *p) {
    const Play *play = p->turn.play;
    const size_t width = p->task.pool->settings.num_observed;

    p->turn.actions += action_bytes(play);
    p->turn.rewards += play->count;
    p->turn.terminated += play->count;
    p->turn.truncated += play->count;
    for (size_t i = 0; i < play->judgement.number_of_seen; i++) {
        p->seen[i] += play->count * p->turn.seen_sizes[i];
    }
    if (p->call.observations != NULL) {
        p->call.observations += play->count * width;
    }
}

static void repeat(char *rows, size_t row, size_t size, size_t count) {
    memcpy(rows + row * size, rows + (ptrdiff_t)(row * size) - (ptrdiff_t)(count * size), size);
}

/* Copies the observations of the step before. */
static void repeat_last(Position *p, size_t index) {
    const Play *play = p->turn.play;
    const size_t width = p->task.pool->settings.num_observed;

    for (size_t i = 0; i < play->judgement.number_of_seen; i++) {
        repeat(p->seen[i], index, p->turn.seen_sizes[i], play->count);
    }
    if (p->call.observations != NULL) {
        repeat((char *)p->call.observations, index, width * sizeof(float), play->count);
    }
}

/* Does one step with a run; over says which of its episodes have ended before. */
static size_t step_run(Position *p, size_t first, size_t count, uint8_t *over, Scratch scratch) {
    uint8_t *ended = p->turn.play->ended + first;

    memcpy(ended, over, count);
    const PlayedRun run = {first, count, &p->registers, &p->verdict};
    const size_t troubled = run_turn(&p->task, run, scratch);
    for (size_t j = 0; j < count; j++) {
        if (over[j]) {
            repeat_last(p, first + j);
        }
        over[j] |= ended[j];
    }
    return troubled;
}

/* What step_run does where all episodes of the run have ended. */
static void leave_out(Position *p, size_t first, size_t count) {
    memset(p->turn.rewards + first, 0, count * sizeof *p->turn.rewards);
    memset(p->turn.terminated + first, 0, count);
    memset(p->turn.truncated + first, 0, count);
    for (size_t j = 0; j < count; j++) {
        repeat_last(p, first + j);
    }
}

static size_t roll_out(Position *p, const Task *task, size_t first, size_t count,
                       Scratch scratch) {
    uint8_t over[ROLLOUT_RUN];
    size_t troubled = 0;

    begin_at_first_step(p, task);
    memset(over, 0, count);
    for (size_t step = 0; step < task->horizon && troubled == 0; step++) {
        if (memchr(over, 0, count) == NULL) {
            leave_out(p, first, count);
        } else {
            troubled = step_run(p, first, count, over, scratch) + p->verdict.troubled;
        }
        go_to_next_step(p);
    }
    memcpy(p->turn.play->ended + first, over, count);
    return troubled;
}

size_t run_rollout(Task *task, size_t begin, size_t end, Scratch scratch) {
    Position p;
    size_t troubled = 0;

    p.verdict = (Verdict){.ended = 0};
    play_open(task->call->turn, &p.registers);
    for (size_t run = begin; run < end && troubled == 0; run++) {
        const size_t first = run * ROLLOUT_RUN, rest = task->pool->settings.count - first;
        const size_t count = rest < ROLLOUT_RUN ? rest : ROLLOUT_RUN;
        troubled += roll_out(&p, task, first, count, scratch);
    }
    if (p.verdict.outside) {
        atomic_add(&task->outside, 1);
    }
    return troubled;
}
