/* Runs of neighbouring instances, which are stepped with their programs. */

#include "pool/runs.h"

#include <float.h>
#include <string.h>

#include "pool/initial_states.h"
#include "pool/instances.h"
#include "pool/recorded_inputs.h"
#include "pool/starts.h"

static Status restore_instance(Task *task, Instance *me, size_t place, Scratch scratch) {
    const size_t index = index_of(task->pool, me);

    if (task->snapshot == NULL) {
        return instance_take_state(task->pool, me, task->states[place]);
    }
    health_count_steps(task->pool, me);
    record_drop(task->pool, index);
    const Kept *kept = &task->snapshot->kept[index];
    const Status status = instance_restore(task->pool, me, kept->state);
    if (status > STATUS_WARNING) {
        return status;
    }
    me->start_time = kept->start_time;
    instance_count_from(me, kept->steps);
    return instance_read_outputs(task->pool, me, scratch);
}

static size_t run_starts(Task *task, size_t begin, size_t end, Scratch scratch) {
    size_t troubled = 0;

    for (size_t first = begin; first < end; first += RUN) {
        const uint32_t *starting = task->pool->chosen + first;
        troubled += start_episodes(task, starting, length_of_run(first, end), scratch);
    }
    return troubled;
}

size_t run_listed(Task *task, size_t begin, size_t end, Scratch scratch) {
    Pool *pool = task->pool;
    const Call *call = task->call;
    size_t troubled = 0;

    if (call->turn != NULL) {
        return run_starts(task, begin, end, scratch);
    }
    for (size_t i = begin; i < end; i++) {
        const size_t index = pool->chosen[i];
        Instance *me = &pool->instances[index];
        const Status status = task->operation == RESTORE ? restore_instance(task, me, i, scratch)
                                                         : instance_reset(pool, me, call, scratch);
        troubled += note_status(task, index, status);
        if (call->observations != NULL) {
            write_observation(pool, index, call->observations);
        }
    }
    return troubled;
}

/* Steps of neighbours */

enum { TOGETHER = 4 /* rows of outputs; transpose takes as many at a time */ };

/* Writes columns as rows. Takes squares of four by four, which compilers load at once. */
WIDE static void transpose(const double *restrict from, size_t from_step, size_t rows,
                           size_t columns, double *restrict to, size_t to_step) {
    size_t column = 0;

    if (rows == 1) { /* as most FMUs have one input */
        for (; column < columns; column++) {
            to[column * to_step] = from[column];
        }
    }
    for (; column + 4 <= columns; column += 4, to += 4 * to_step) {
        const double *next = from + column;
        size_t row = 0;
        for (; row + 4 <= rows; row += 4, next += 4 * from_step) {
            for (size_t k = 0; k < 4; k++) {
                double *place = to + k * to_step + row;
                place[0] = next[k];
                place[1] = next[k + from_step];
                place[2] = next[k + 2 * from_step];
                place[3] = next[k + 3 * from_step];
            }
        }
        for (; row < rows; row++, next += from_step) {
            for (size_t k = 0; k < 4; k++) {
                to[k * to_step + row] = next[k];
            }
        }
    }
    for (; column < columns; column++, to += to_step) {
        const double *next = from + column;
        UNROLLED
        for (size_t row = 0; row < rows; row++, next += from_step) {
            to[row] = *next;
        }
    }
}

static void gather_each(const Matrix *matrix, size_t begin, size_t count, size_t width,
                        double *inputs) {
    for (size_t i = 0; i < width; i++) {
        const char *place = matrix->data + (ptrdiff_t)i * matrix->row_stride +
                            (ptrdiff_t)begin * matrix->column_stride;
        double *to = inputs + i;
        for (size_t j = 0; j < count; j++, place += matrix->column_stride, to += width) {
            memcpy(to, place, sizeof *to);
        }
    }
}

static void gather_inputs(const Task *task, size_t begin, size_t count, double *inputs) {
    const Matrix *matrix = &task->call->inputs;
    const size_t width = task->pool->settings.inputs->count;
    const ptrdiff_t size = sizeof *inputs;

    if (count > 1 && matrix->column_stride == size && matrix->row_stride % size == 0 &&
        matrix->row_stride >= 0 && (uintptr_t)matrix->data % sizeof *inputs == 0) {
        const double *rows = (const double *)(const void *)matrix->data + begin;
        transpose(rows, (size_t)(matrix->row_stride / size), width, count, inputs, width);
    } else {
        gather_each(matrix, begin, count, width, inputs);
    }
}

/* Handles outputs that are not finite: the instance fails, and its outputs keep their old
 * values. */
static size_t take_not_finite(Task *task, size_t begin, size_t count, double *outputs) {
    Pool *pool = task->pool;
    const size_t width = pool->settings.outputs->count;
    size_t troubled = 0;

    for (size_t j = 0; j < count; j++, outputs += width) {
        Instance *me = &pool->instances[begin + j];
        if (!are_finite(outputs, width)) {
            const bool counted = pool->settings.status[begin + j] > STATUS_WARNING;
            note_status(task, begin + j, instance_note_not_finite(me, BAD_OUTPUTS, outputs, width));
            troubled += !counted;
            instance_copy_outputs(pool, me, outputs);
        }
    }
    return troubled;
}

/* Moves some outputs of a run, from the first of them on, into their rows. For a single instance, the
 * call would take longer than the move. */
static inline void keep_outputs(const Task *task, size_t begin, size_t count, size_t first,
                                size_t number, const double *outputs) {
    const Settings *s = &task->pool->settings;
    double *rows = s->output_values + first * s->count + begin;

    if (count > 1) {
        transpose(outputs + first, s->outputs->count, count, number, rows, s->count);
        return;
    }
    for (size_t i = 0; i < number; i++) {
        rows[i * s->count] = outputs[first + i];
    }
}

WIDE static void convert(const double *values, size_t count, float *converted) {
    for (size_t i = 0; i < count; i++) {
        converted[i] = (float)values[i];
    }
}

static void write_observations(const Task *task, size_t begin, size_t count,
                               const double *outputs) {
    const size_t width = task->pool->settings.outputs->count;
    const size_t observed = task->pool->settings.num_observed;
    float *rows = task->call->observations + begin * observed;

    if (observed == width) {
        convert(outputs, count * width, rows);
        return;
    }
    for (size_t j = 0; j < count; j++) {
        convert(outputs + j * width, observed, rows + j * observed);
    }
}

/* The same scratch memory, starting at a later instance of the run. */
static Scratch scratch_from(const Pool *pool, Scratch scratch, size_t place) {
    scratch.inputs += place * pool->settings.inputs->count;
    scratch.outputs += place * pool->settings.outputs->count;
    return scratch;
}

/* If a step has produced no outputs, hands out the previous ones. */
static size_t conclude_step(Task *task, size_t index, Status status, double *outputs) {
    if (status > STATUS_WARNING && status != STATUS_TERMINATED) {
        instance_copy_outputs(task->pool, &task->pool->instances[index], outputs);
    }
    return note_status(task, index, status);
}

/* Resets an instance in the mask and steps any other. A plain step does not touch those in the
 * mask. */
static size_t do_one(Task *task, size_t index, Scratch scratch) {
    Pool *pool = task->pool;
    const Call *call = task->call;
    Instance *me = &pool->instances[index];
    size_t troubled = 0;

    if (!is_in(call->mask, index)) {
        return conclude_step(task, index, instance_step(pool, me, scratch), scratch.outputs);
    }
    if (task->operation != STEP) {
        troubled = start_instance(task, index, scratch);
    }
    instance_copy_outputs(pool, me, scratch.outputs);
    return troubled;
}

/* Splits a run into the instances that one call of the FMI version steps together, and the
 * others. Both lists hold places in the run. */
typedef struct {
    size_t count, others;
    uint32_t places[RUN], other_places[RUN];
    void *components[RUN];
    double times[RUN];
    Outcome outcomes[RUN];
} LineUp;

/* Whether none of a run is in the mask. */
static bool is_none_in(Mask mask, size_t begin, size_t count) {
    unsigned char any = 0;

    for (size_t j = 0; mask.data != NULL && j < count; j++) {
        any |= (unsigned char)mask.data[(ptrdiff_t)(begin + j) * mask.stride];
    }
    return any == 0;
}

/* Lines up a run of which nearly always all instances step. Returns whether they do; otherwise
 * nothing has happened. */
static bool line_up_all(const Pool *pool, size_t begin, size_t count, LineUp *line) {
    Instance *first = &pool->instances[begin];
    const Library *library = first->library;
    bool all = true;

    for (size_t j = 0; j < count; j++) {
        const Instance *me = first + j;
        line->components[j] = me->component;
        line->times[j] = instance_time(pool, me);
        line->places[j] = (uint32_t)j;
        all &= (me->phase == PHASE_STEPPING) & (me->library == library);
    }
    for (size_t j = 0; all && j < count; j++) {
        first[j].steps++;
    }
    line->count = all ? count : 0;
    line->others = 0;
    return all;
}

/* Counts the steps as done before they happen. Avoids branches, because the processor cannot
 * predict which episodes have ended. */
static void line_up(const Task *task, size_t begin, size_t count, bool together, LineUp *line) {
    const Pool *pool = task->pool;
    const Library *library = pool->instances[begin].library;
    const Mask mask = task->call->mask;
    size_t steppers = 0, others = 0;

    if (together && is_none_in(mask, begin, count) && line_up_all(pool, begin, count, line)) {
        return;
    }
    for (size_t j = 0; j < count; j++) {
        Instance *me = &pool->instances[begin + j];
        const bool steps = together & !is_in(mask, begin + j) & (me->phase == PHASE_STEPPING) &
                           (me->library == library);

        line->places[steppers] = line->other_places[others] = (uint32_t)j;
        line->components[steppers] = me->component;
        line->times[steppers] = instance_time(pool, me);
        me->steps += steps;
        steppers += steps;
        others += !steps;
    }
    line->count = steppers;
    line->others = others;
}

/* Prefetches the memory that a reset will read, if there is a reset. It is spread over many
 * places. */
static void foresee_reset(const Task *task, size_t index) {
    const Call *call = task->call;
    const Matrix *values = &call->start_values;
    const char *place = values->data + (ptrdiff_t)index * values->column_stride;

    if (task->operation == STEP || !is_in(call->mask, index)) {
        return;
    }
    for (size_t i = 0; i < call->start->count; i++, place += values->row_stride) {
        prefetch(place);
    }
    if (call->turn != NULL) {
        play_foresee(call->turn->play, index);
    }
}

static Status status_of(Pool *pool, Instance *me, double time, Outcome outcome) {
    if (outcome.status <= STATUS_WARNING) {
        return outcome.status;
    }
    if (outcome.stage == SETTING_INPUTS) {
        me->steps--;
        return instance_fail_setting(pool, me, outcome.status);
    }
    return outcome.stage == DOING_STEP ? instance_fail_step(pool, me, time, outcome.status)
                                       : instance_fail_reading(pool, me, outcome.status);
}

static size_t conclude_steps(Task *task, size_t begin, const LineUp *line, Scratch scratch) {
    Pool *pool = task->pool;
    size_t troubled = 0;

    for (size_t i = 0; i < line->count; i++) {
        const size_t place = line->places[i], index = begin + place;
        const Status status =
            status_of(pool, &pool->instances[index], line->times[i], line->outcomes[i]);
        double *outputs = scratch_from(pool, scratch, place).outputs;
        troubled += conclude_step(task, index, status, outputs);
    }
    return troubled;
}

static Exchange exchange_of(const Pool *pool, Scratch scratch) {
    const Access *in = pool->settings.inputs, *out = pool->settings.outputs;

    return (Exchange){.input_references = in->groups[0].references,
                      .output_references = out->groups[0].references,
                      .number_of_inputs = in->count,
                      .number_of_outputs = out->count,
                      .step = pool->step_size,
                      .no_return = pool->no_return,
                      .floats = &pool->floats,
                      .inputs = scratch.inputs,
                      .outputs = scratch.outputs};
}

static size_t step_together(Task *task, size_t begin, LineUp *line, Scratch scratch) {
    const Pool *pool = task->pool;
    Exchange e = exchange_of(pool, scratch);

    e.count = line->count;
    e.components = line->components;
    e.places = line->places;
    e.times = line->times;
    e.outcomes = line->outcomes;
    if (!pool->settings.fmi->exchange(pool->instances[begin].library, &e)) {
        return conclude_steps(task, begin, line, scratch);
    }
    int8_t *status = pool->settings.status + begin;
    for (size_t i = 0; i < e.count; i++) {
        status[e.places[i]] = STATUS_OK;
    }
    return 0;
}

static size_t do_each(Task *task, size_t begin, size_t count, Scratch scratch) {
    const Pool *pool = task->pool;
    LineUp line;
    size_t troubled = 0;

    line_up(task, begin, count, pool->direct && scratch.sound, &line);
    for (size_t i = 0; i < line.others; i++) {
        foresee_reset(task, begin + line.other_places[i]);
    }
    if (line.count > 0) {
        troubled += step_together(task, begin, &line, scratch);
    }
    for (size_t i = 0; i < line.others; i++) {
        const size_t place = line.other_places[i];
        troubled += do_one(task, begin + place, scratch_from(pool, scratch, place));
    }
    return troubled;
}

/* Handles outputs of which some are not finite, or too large for the observations of a float32.
 * The latter are a fault of the episode. */
static size_t take_not_small(Task *task, size_t begin, size_t count, double *outputs) {
    const size_t width = task->pool->settings.outputs->count;
    size_t troubled = 0;

    if (!all_within(outputs, count * width, DBL_MAX)) {
        troubled += take_not_finite(task, begin, count, outputs);
    }
    if (task->call->turn != NULL && task->call->observations != NULL) {
        troubled += !all_within(outputs, count * width, FLOAT32_LIMIT);
    }
    return troubled;
}

/* Steps or resets a run, and leaves the outputs in the scratch memory. For a single instance, a call
 * with so many arguments is a part of its step. */
static ALWAYS_INLINE size_t advance(Task *task, size_t begin, size_t count, Scratch scratch,
                                    bool *fits_floats) {
    const size_t width = task->pool->settings.outputs->count;

    gather_inputs(task, begin, count, scratch.inputs);
    records_add(task->pool, begin, count, task->call->mask, scratch.inputs);
    scratch.sound = are_finite(scratch.inputs, count * task->pool->settings.inputs->count);
    size_t troubled = do_each(task, begin, count, scratch);
    *fits_floats = all_within(scratch.outputs, count * width, FLOAT32_LIMIT);
    if (!*fits_floats) {
        troubled += take_not_small(task, begin, count, scratch.outputs);
    }
    if (task->call->observations != NULL) {
        write_observations(task, begin, count, scratch.outputs);
    }
    return troubled;
}

/* Takes over what other processes have left, as advance leaves it. Their outputs are finite. */
static size_t take_over(const Task *task, size_t begin, size_t count, Scratch scratch,
                        bool *fits_floats) {
    const Settings *s = &task->pool->settings;
    const size_t width = s->outputs->count;
    size_t troubled = 0;

    for (size_t i = 0; i < width; i++) {
        const double *row = s->output_values + i * s->count + begin;
        for (size_t j = 0; j < count; j++) {
            scratch.outputs[j * width + i] = row[j];
        }
    }
    for (size_t j = 0; j < count; j++) {
        troubled += s->status[begin + j] > STATUS_WARNING;
    }
    *fits_floats = all_within(scratch.outputs, count * width, FLOAT32_LIMIT);
    if (task->call->observations != NULL) {
        troubled += !*fits_floats;
        write_observations(task, begin, count, scratch.outputs);
    }
    return troubled;
}

static size_t run_step(Task *task, size_t begin, size_t count, Scratch scratch) {
    bool fits_floats;
    const size_t troubled = advance(task, begin, count, scratch, &fits_floats);

    keep_outputs(task, begin, count, 0, task->pool->settings.outputs->count, scratch.outputs);
    return troubled;
}

/* Moves the outputs of a run into their rows, and those before the step from there into the rows that
 * keep them, unless a program reads these. It takes few rows at a time, which stay in the cache for
 * both: rows of many instances would drive each other out of it. */
static void replace_outputs(const Task *task, size_t begin, size_t count, const double *outputs) {
    const Play *play = task->call->turn->play;
    const size_t width = task->pool->settings.outputs->count;

    for (size_t i = 0; i < width; i += TOGETHER) {
        const size_t number = width - i < TOGETHER ? width - i : TOGETHER;
        if (!play->reads_kept) {
            play_keep_outputs(play, i, number, begin, count);
        }
        keep_outputs(task, begin, count, i, number, outputs);
    }
}

/* Steps or resets one run, and runs the programs before and after. */
static size_t run_turn(Task *task, PlayedRun run, Scratch scratch) {
    const Turn *turn = task->call->turn;
    Fresh fresh = {scratch.outputs, task->pool->settings.outputs->count, true};
    Listed starting;
    size_t troubled;

    play_list_ended(turn->play, run.begin, run.count, &starting);
    if (task->operation == AFTER) {
        troubled = take_over(task, run.begin, run.count, scratch, &fresh.fits_floats);
    } else {
        play_prepare(turn, run.begin, run.count, run.scratch);
        troubled = advance(task, run.begin, run.count, scratch, &fresh.fits_floats);
        replace_outputs(task, run.begin, run.count, scratch.outputs);
        play_start_episodes(turn, starting.places, starting.count);
    }
    play_conclude(turn, run.begin, run.count, &fresh, &starting, run.scratch, run.verdict);
    return troubled;
}

size_t run_steps(Task *task, size_t begin, size_t end, Scratch scratch) {
    size_t troubled = 0;
    for (size_t first = begin; first < end; first += RUN) {
        troubled += run_step(task, first, length_of_run(first, end), scratch);
    }
    return troubled;
}

size_t run_play(Task *task, size_t begin, size_t end, Scratch scratch) {
    const Turn *turn = task->call->turn;
    PlayScratch programs;
    Verdict verdict = {.ended = 0};
    size_t troubled = 0, started = 0;

    play_open(turn, &programs);
    for (size_t first = begin; first < end; first += RUN) {
        const PlayedRun run = {first, length_of_run(first, end), &programs, &verdict};
        troubled += run_turn(task, run, scratch);
        if (turn->started != NULL) {
            troubled += starts_after_ends(task, run, scratch, &started);
        }
    }
    atomic_add(&task->ended, verdict.ended);
    atomic_add(&task->started, started);
    if (verdict.outside) {
        atomic_add(&task->outside, 1);
    }
    return troubled + verdict.troubled;
}

size_t run_before(Task *task, size_t begin, size_t end) {
    const Turn *turn = task->call->turn;
    const Play *play = turn->play;
    PlayScratch programs;

    play_open(turn, &programs);
    for (size_t first = begin; first < end; first += RUN) {
        play_prepare(turn, first, length_of_run(first, end), &programs);
        if (!play->reads_kept) {
            play_keep_outputs(play, 0, play->number_of_outputs, first, length_of_run(first, end));
        }
    }
    return 0;
}
