/* The parts of a vector environment's step around the steps of the instances. */

#include "pool/play.h"

#include <string.h>

#include "shared/platform.h"

WIDE static bool is_any_outside(const int64_t *values, size_t count, int64_t lowest,
                                int64_t highest) {
    int64_t outside = 0; /* as wide as the values, so that the compiler can vectorize */

    for (size_t i = 0; i < count; i++) {
        outside |= (values[i] < lowest) | (values[i] > highest);
    }
    return outside != 0;
}

/* The notes are as wide as the values, so that the compiler can vectorize. */
#define ANY_NAN(Type, name, Whole)                                                                 \
    WIDE static bool name(const Type *values, size_t count) {                                      \
        Whole any = 0;                                                                             \
        for (size_t i = 0; i < count; i++) {                                                       \
            any |= values[i] != values[i];                                                         \
        }                                                                                          \
        return any != 0;                                                                           \
    }

ANY_NAN(double, is_any_nan, int64_t)
ANY_NAN(float, is_any_nan32, int32_t)

bool play_has_bad_action(const Turn *turn) {
    const Actions *a = &turn->play->actions;
    const size_t count = turn->play->count * a->elements;
    const void *actions = turn->actions;

    switch (a->check) {
    case ACTIONS_IN_RANGE:
        return is_any_outside(actions, count, a->lowest, a->highest);
    case ACTIONS_FLOAT64:
        return is_any_nan(actions, count);
    case ACTIONS_FLOAT32:
        return is_any_nan32(actions, count);
    default:
        return false;
    }
}

void play_foresee(const Play *play, size_t index) {
    prefetch(&play->streams[index]);
}

void play_draw(const Turn *turn, size_t index) {
    const Play *play = turn->play;
    double *values = turn->drawn + index;

    if (turn->drawn == NULL) { /* another thread has ended the episode since the call */
        return;
    }
    BitGenerator bits = bits_of(&play->streams[index]);
    draws_take(play->draws, &bits, values, play->count);
    draws_start(play->draws, values, play->start_values + index, play->count);
}

static Source source_of(const Turn *turn) {
    Source source = turn->play->source;

    source.arrays = turn->arrays;
    return source;
}

void play_open(const Turn *turn, PlayScratch *scratch) {
    program_prepare(&turn->play->inputs, scratch->memory, &scratch->inputs);
    program_prepare(&turn->play->conclusion, scratch->memory, &scratch->conclusion);
    program_prepare(&turn->play->observation, scratch->memory, &scratch->observation);
}

static void take_actions(const Turn *turn, size_t begin, size_t count) {
    const Actions *a = &turn->play->actions;
    const size_t size = a->elements * a->size, offset = begin * size;

    memcpy(a->previous + offset, a->current + offset, count * size);
    memcpy(a->current + offset, turn->actions + offset, count * size);
}

void play_keep_outputs(const Play *play, size_t first, size_t number, size_t begin, size_t count) {
    for (size_t i = first; i < first + number; i++) {
        const size_t place = i * play->count + begin;
        memcpy(play->kept_rows + place, play->output_rows + place, count * sizeof(double));
    }
}

static void copy_rows(const RowCopies *copies, size_t begin, size_t count) {
    for (size_t i = 0; i < copies->count; i++) {
        const Row *from = &copies->rows[i].from, *to = &copies->rows[i].to;
        memcpy(to->data + begin * to->size, from->data + begin * from->size, count * to->size);
    }
}

void play_prepare(const Turn *turn, size_t begin, size_t count, PlayScratch *scratch) {
    const Play *play = turn->play;
    Notes notes = {.outside = false};

    take_actions(turn, begin, count);
    copy_rows(&play->before_inputs, begin, count);
    const Source source = source_of(turn);
    program_run(&play->inputs, &source, begin, count, &scratch->inputs, &notes);
    if (play->reads_kept) {
        play_keep_outputs(play, 0, play->number_of_outputs, begin, count);
    }
}

/* An episode that starts has no action yet. */
static void forget_actions(const Actions *a, size_t index) {
    const size_t size = a->elements * a->size;

    memcpy(a->previous + index * size, a->none, size);
    memcpy(a->current + index * size, a->none, size);
}

/* Most values are numbers or flags, whose sizes the compiler then knows. */
static inline void put(char *to, const char *from, size_t size) {
    if (size == sizeof(double)) {
        memcpy(to, from, sizeof(double));
    } else if (size == 1) {
        *to = *from;
    } else {
        memcpy(to, from, size);
    }
}

static void start_row(const RowStart *start, char *to, const char *from, const uint32_t *starting,
                      size_t count) {
    const size_t size = start->to.size;

    for (size_t j = 0; j < count; j++) {
        const size_t place = starting[j] * size;
        put(to + place, from + place, size);
    }
}

static void start_constant(const RowStart *start, char *to, const uint32_t *starting,
                           size_t count) {
    const size_t size = start->to.size;

    for (size_t j = 0; j < count; j++) {
        put(to + starting[j] * size, (const char *)&start->from.bits, size);
    }
}

/* Fills one row after the other, because each is far from the next one in memory. */
static void start_rows(const Turn *turn, const RowStarts *starts, const uint32_t *starting,
                       size_t count) {
    for (size_t i = 0; i < starts->count; i++) {
        const RowStart *start = &starts->rows[i];
        char *to = row_begin(&start->to, turn->arrays);
        if (start->kind == START_CONSTANT) {
            start_constant(start, to, starting, count);
        } else if (start->kind == START_ROW) {
            start_row(start, to, start->from.row, starting, count);
        } else if (turn->drawn != NULL) {
            const double *values = turn->drawn + start->from.draw * turn->play->count;
            start_row(start, to, (const char *)values, starting, count);
        }
    }
}

void play_start_episodes(const Turn *turn, const uint32_t *starting, size_t count) {
    for (size_t j = 0; j < count; j++) {
        forget_actions(&turn->play->actions, starting[j]);
    }
    start_rows(turn, &turn->play->starts, starting, count);
}

WIDE static bool is_any(const uint8_t *flags, size_t count) {
    uint8_t any = 0;

    for (size_t j = 0; j < count; j++) {
        any |= flags[j];
    }
    return any != 0;
}

void play_list_ended(const Play *play, size_t begin, size_t count, Listed *ended) {
    ended->count = 0;
    if (!is_any(play->ended + begin, count)) {
        return;
    }
    for (size_t index = begin; index < begin + count; index++) {
        if (play->ended[index]) {
            ended->places[ended->count++] = (uint32_t)index;
        }
    }
}

WIDE static size_t number_of(const uint8_t *flags, size_t count) {
    uint8_t number = 0;

    for (size_t j = 0; j < count; j++) {
        number += flags[j];
    }
    return number;
}

static void add_notes(const Notes *notes, size_t count, Verdict *verdict) {
    verdict->outside |= notes->outside;
    if (is_any(notes->not_finite, count)) {
        for (size_t j = 0; j < count; j++) {
            verdict->troubled += notes->not_finite[j];
        }
    }
}

void play_conclude(const Turn *turn, size_t begin, size_t count, const Fresh *fresh,
                   const Listed *starting, PlayScratch *scratch, Verdict *verdict) {
    const Play *play = turn->play;
    Source source = source_of(turn);
    Notes notes = {.outside = false};

    source.fresh = fresh;
    copy_rows(&play->before_conclusion, begin, count);
    program_run(&play->conclusion, &source, begin, count, &scratch->conclusion, &notes);
    memcpy(verdict->not_finite, notes.not_finite, sizeof notes.not_finite);
    add_notes(&notes, count, verdict);
    start_rows(turn, &play->unstepped, starting->places, starting->count);
    verdict->ended += number_of(play->ended + begin, count);
}

void play_observe(const Turn *turn, size_t begin, size_t count, PlayScratch *scratch,
                  Verdict *verdict) {
    const Play *play = turn->play;
    const Source source = source_of(turn);
    Notes notes = {.outside = false};

    if (play->observation.length == 0) {
        return;
    }
    copy_rows(&play->before_conclusion, begin, count);
    program_run(&play->observation, &source, begin, count, &scratch->observation, &notes);
    add_notes(&notes, count, verdict);
}

void play_skip(const Turn *turn, size_t index) {
    const Play *play = turn->play;

    for (size_t i = 0; i < play->number_of_arrays; i++) {
        memset(turn->arrays[i] + index * play->array_sizes[i], 0, play->array_sizes[i]);
    }
    if (turn->started != NULL) {
        turn->started[index] = 0;
    }
}
