#include "play.h"

#include "platform.h"

enum { DONE, TRUNCATED, REWARD };

WIDE static bool is_any_outside(const int64_t *values, size_t count, int64_t lowest,
                                int64_t highest) {
    int64_t outside = 0; /* as wide as the values, so that the compiler can vectorize */

    for (size_t i = 0; i < count; i++) {
        outside |= (values[i] < lowest) | (values[i] > highest);
    }
    return outside != 0;
}

bool play_has_bad_action(const Turn *turn) {
    const Play *play = turn->play;
    return is_any_outside(turn->actions, play->count, play->lowest_action, play->highest_action);
}

void play_foresee(const Play *play, size_t index) {
    prefetch(&play->streams[index]);
}

void play_draw(const Turn *turn, size_t index) {
    const Play *play = turn->play;
    const Draws *d = play->draws;
    double *values = turn->drawn + index;

    draws_take(d, &play->streams[index], values, play->count);
    for (size_t i = 0; i < d->count; i++) {
        if (d->draws[i].row >= 0) {
            play->start_values[(size_t)d->draws[i].row * play->count + index] =
                values[i * play->count];
        }
    }
}

static Source source_of(const Turn *turn) {
    Source source = turn->play->source;
    source.actions = turn->actions;
    return source;
}

void play_open(const Turn *turn, PlayScratch *scratch) {
    program_prepare(&turn->play->inputs, scratch->inputs);
    program_prepare(&turn->play->judgement, scratch->judgement);
}

void play_prepare(const Turn *turn, size_t begin, size_t count, PlayScratch *scratch) {
    const Play *play = turn->play;
    const Source source = source_of(turn);

    program_run(&play->inputs, &source, begin, count, scratch->inputs);
    for (size_t i = 0; i < play->inputs.number_of_results; i++) {
        const double *values = scratch->inputs[play->inputs.results[i]];
        double *row = play->input_rows + i * play->count + begin;
        for (size_t j = 0; j < count; j++) {
            row[j] = values[j];
        }
    }
    for (size_t index = begin; index < begin + count; index++) {
        play->step_counts[index] = play->ended[index] ? 0 : play->step_counts[index] + 1;
    }
}

/* Avoids branches, because the processor could not predict them. Handles the wide values first,
 * then the bytes. */
WIDE static size_t judge(const Turn *turn, size_t begin, size_t count, const double *dones,
                         const double *cuts, const double *rewards) {
    const Play *play = turn->play;
    const int64_t *step_counts = play->step_counts + begin;
    const int64_t limit = play->limit;
    uint8_t *restrict ended = play->ended + begin;
    uint8_t *restrict terminated = turn->terminated + begin;
    uint8_t *restrict truncated = turn->truncated + begin;
    double *restrict given = turn->rewards + begin;
    uint8_t done[PROGRAM_WIDTH], cut[PROGRAM_WIDTH], number = 0;

    for (size_t j = 0; j < PROGRAM_WIDTH; j++) {
        done[j] = dones[j] != 0.0;
        cut[j] = cuts[j] != 0.0;
    }
    for (size_t j = 0; j < count; j++) {
        cut[j] |= step_counts[j] >= limit;
    }
    for (size_t j = 0; j < count; j++) {
        given[j] = ended[j] ? 0.0 : rewards[j];
    }
    for (size_t j = 0; j < count; j++) {
        terminated[j] = done[j] & !ended[j];
        truncated[j] = cut[j] & !ended[j];
        ended[j] = terminated[j] | truncated[j];
        number += ended[j];
    }
    return number;
}

size_t play_judge(const Turn *turn, size_t begin, size_t count, PlayScratch *scratch) {
    const Play *play = turn->play;
    const Source source = source_of(turn);
    const uint16_t *results = play->judgement.results;

    program_run(&play->judgement, &source, begin, count, scratch->judgement);
    return judge(turn, begin, count, scratch->judgement[results[DONE]],
                 scratch->judgement[results[TRUNCATED]], scratch->judgement[results[REWARD]]);
}

void play_skip(const Turn *turn, size_t index) {
    turn->rewards[index] = 0.0;
    turn->terminated[index] = turn->truncated[index] = 0;
}
