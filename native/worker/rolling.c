/* Rollouts: many steps of the instances in one request, compiled hooks included.
 *
 * The rows that programs read and write are memory of the other process. So the worker has rows of its
 * own, and their values come with each request. First are the rows of the inputs, of the outputs and
 * of the outputs before a step; then the counts of steps; then the other ones. */

#include <stdlib.h>
#include <string.h>

#include "../rollouts.h"
#include "worker.h"

struct Rolling {
    Play play;
    ProgramForm inputs, judgement;
    char *form; /* a copy of the request, which the play points to */
    double *input_rows, *kept;
    char **others; /* the other rows */
    size_t number_of_others;
    Row *rows; /* all */
    size_t number_of_rows;
    RowCopy *copies;
    uint8_t *ended;
};

static void rolling_drop(Rolling *r) {
    if (r == NULL) {
        return;
    }
    for (size_t i = 0; i < r->number_of_others; i++) {
        free(r->others[i]);
    }
    program_drop(&r->inputs);
    program_drop(&r->judgement);
    free(r->play.actions.current);
    free(r->play.actions.previous);
    free(r->form);
    free(r->input_rows);
    free(r->kept);
    free(r->others);
    free(r->rows);
    free(r->copies);
    free(r->ended);
    free(r);
}

static void *zeros(size_t size) {
    return memset(memory_for(NULL, size), 0, size);
}

/* Preparing */

static char *row_of(const Settings *s, double *rows, size_t index) {
    return (char *)(rows + index * s->count);
}

/* A program may take a row for one of wider values. */
static char *other_row(const Settings *s, size_t size) {
    return zeros(s->count * size + PROGRAM_WIDTH * sizeof(double));
}

static void read_rows(Worker *w, Reader *reader, Rolling *r) {
    const Settings *s = &w->opening.settings;
    const size_t in = s->inputs->count, out = s->outputs->count;
    size_t others;
    const int64_t *sizes = read_array(reader, sizeof *sizes, &others);

    r->input_rows = zeros(in * s->count * sizeof(double));
    r->kept = zeros(out * s->count * sizeof(double));
    r->rows = zeros((in + 2 * out + 1 + others) * sizeof *r->rows);
    r->others = zeros(others * sizeof *r->others);
    Row *row = r->rows;
    for (size_t i = 0; i < in; i++) {
        *row++ = (Row){.data = row_of(s, r->input_rows, i), .size = sizeof(double)};
    }
    for (size_t i = 0; i < out; i++) {
        *row++ = (Row){.data = row_of(s, w->output_values, i), .size = sizeof(double)};
    }
    for (size_t i = 0; i < out; i++) {
        *row++ = (Row){.data = row_of(s, r->kept, i), .size = sizeof(double)};
    }
    *row++ = (Row){.data = (char *)w->shared.progress, .size = sizeof(int64_t)};
    for (size_t i = 0; i < others && reader->fault == NULL; i++) {
        if (sizes[i] != 1 && sizes[i] != 4 && sizes[i] != 8) {
            reader_refuse(reader, "there are no values of this size");
            break;
        }
        r->others[r->number_of_others++] = other_row(s, (size_t)sizes[i]);
        *row++ = (Row){.data = r->others[i], .size = (size_t)sizes[i]};
    }
    r->number_of_rows = (size_t)(row - r->rows);
}

static void read_copies(Reader *reader, Rolling *r) {
    size_t count;
    const int64_t *pairs = read_array(reader, 2 * sizeof *pairs, &count);

    r->copies = zeros(count * sizeof *r->copies);
    for (size_t i = 0; i < count && reader->fault == NULL; i++) {
        const uint64_t from = (uint64_t)pairs[2 * i], to = (uint64_t)pairs[2 * i + 1];
        if (from >= r->number_of_rows || to >= r->number_of_rows ||
            r->rows[from].size != r->rows[to].size) {
            reader_refuse(reader, "rows to copy differ in type, or do not exist");
            break;
        }
        r->copies[i] = (RowCopy){r->rows[from], r->rows[to]};
    }
    r->play.copies = r->copies;
    r->play.number_of_copies = count;
}

static void read_actions(Worker *w, Reader *reader, Actions *a) {
    a->elements = (size_t)read_integer_in(reader, 0, UINT16_MAX);
    a->size = (size_t)read_integer_in(reader, 1, 8);
    a->check = (ActionCheck)read_integer_in(reader, ACTIONS_ANY, ACTIONS_FLOAT32);
    a->lowest = read_integer(reader);
    a->highest = read_integer(reader);
    const bool keeps = read_flag(reader);
    const Block none = read_block(reader);
    const size_t checked = a->check == ACTIONS_ANY ? a->size : a->check == ACTIONS_FLOAT32 ? 4 : 8;
    if (none.size != a->elements * a->size || a->size != checked) {
        reader_refuse(reader, "actions differ in type");
    }
    a->none = none.bytes;
    if (keeps && reader->fault == NULL) {
        const size_t size = w->opening.settings.count * a->elements * a->size;
        a->current = zeros(size);
        a->previous = zeros(size);
    }
}

/* Its rows come as numbers among all. */
static void read_program(Worker *w, Reader *reader, Rolling *r, ProgramForm *program) {
    const Settings *s = &w->opening.settings;
    const Block form = read_block(reader);
    size_t count;
    const int64_t *numbers = read_array(reader, sizeof *numbers, &count);
    Row *rows = zeros(count * sizeof *rows);

    for (size_t i = 0; i < count && reader->fault == NULL; i++) {
        if (numbers[i] < 0 || (uint64_t)numbers[i] >= r->number_of_rows) {
            reader_refuse(reader, "there is no such row");
            break;
        }
        rows[i] = r->rows[numbers[i]];
    }
    const char *fault = reader->fault;
    fault = fault == NULL ? program_take(program, form.bytes, form.size, count) : fault;
    fault = fault == NULL ? program_settle(program, rows, r->play.actions.elements) : fault;
    if (fault != NULL) {
        reader_refuse(reader, fault);
    } else {
        program_note_outputs(program, w->output_values, s->outputs->count, s->count);
    }
    free(rows);
}

static void settle(Worker *w, Rolling *r) {
    const Settings *s = &w->opening.settings;
    Play *play = &r->play;

    play->count = s->count;
    play->inputs = r->inputs.program;
    play->judgement = r->judgement.program;
    play->source.statuses = w->statuses;
    play->input_rows = r->input_rows;
    play->number_of_inputs = s->inputs->count;
    play->output_rows = w->output_values;
    play->kept_rows = r->kept;
    play->number_of_outputs = s->outputs->count;
    play->step_counts = w->shared.progress;
    play->ended = r->ended = zeros(s->count);
}

static void prepare(Worker *w, Block form) {
    Rolling *r = zeros(sizeof *r);

    rolling_drop(w->rolling);
    w->rolling = r;
    r->form = memory_for(NULL, form.size);
    memcpy(r->form, form.bytes, form.size);
    Reader reader = {r->form, r->form + form.size, NULL};
    r->play.reads_kept = read_flag(&reader);
    r->play.limit = read_integer(&reader);
    read_actions(w, &reader, &r->play.actions);
    read_rows(w, &reader, r);
    read_copies(&reader, r);
    read_program(w, &reader, r, &r->inputs);
    read_program(w, &reader, r, &r->judgement);
    if (r->inputs.program.number_of_seen > 0 ||
        r->judgement.program.number_of_results != PROGRAM_RESULTS ||
        reader.at != reader.end || reader.fault != NULL) {
        rolling_drop(r);
        w->rolling = NULL;
    } else {
        settle(w, r);
    }
}

/* Rolling out */

/* Reads values into memory of the worker. */
static void fill(Reader *reader, void *to, size_t size) {
    const Block block = read_block(reader);

    if (block.size != size) {
        reader_refuse(reader, "the values of a rollout differ in number");
    } else if (size > 0) {
        memcpy(to, block.bytes, size);
    }
}

static void read_values(Worker *w, Reader *reader, Rolling *r) {
    const Settings *s = &w->opening.settings;
    const size_t first = s->inputs->count + s->outputs->count;
    const Actions *a = &r->play.actions;

    for (size_t i = 0; i < s->inputs->count; i++) {
        memcpy(r->input_rows + i * s->count, w->shared.inputs + i * w->shared.stride,
               s->count * sizeof(double));
    }
    for (size_t i = first; i < r->number_of_rows; i++) {
        if (r->rows[i].data != (char *)w->shared.progress) {
            fill(reader, r->rows[i].data, s->count * r->rows[i].size);
        }
    }
    if (a->current != NULL) {
        fill(reader, a->current, s->count * a->elements * a->size);
        fill(reader, a->previous, s->count * a->elements * a->size);
    }
}

/* The arrays of a rollout, with a row for each step. They lie one after the other in the answer. */
typedef struct {
    Call call;
    Turn turn;
    char *seen[MOST_SEEN];
    size_t seen_sizes[MOST_SEEN]; /* bytes of one environment */
    size_t horizon, arrays;
} Rollout;

static bool makes_observations(const Rolling *r) {
    return r->judgement.program.number_of_seen > 0;
}

static void measure(Worker *w, Rolling *r, Rollout *o) {
    o->arrays = makes_observations(r) ? r->judgement.program.number_of_seen : 1;
    for (size_t i = 0; i < o->arrays; i++) {
        o->seen_sizes[i] = makes_observations(r)
                               ? r->judgement.seen_sizes[i]
                               : w->opening.settings.num_observed * sizeof(float);
    }
}

/* The blocks of the answer. Its bytes move while it grows, so that the places come afterwards. */
static void make_room(Worker *w, const Rollout *o, Writer *writer) {
    const size_t rows = o->horizon * w->opening.settings.count;

    for (size_t i = 0; i < o->arrays; i++) {
        write_room(writer, rows * o->seen_sizes[i]);
    }
    write_room(writer, rows * sizeof(double));
    write_room(writer, rows);
    write_room(writer, rows);
}

static char *next_array(Reader *reader) {
    return (char *)read_block(reader).bytes;
}

static void settle_rollout(Worker *w, Rolling *r, Rollout *o, Writer *writer, size_t begin) {
    Reader reader = {writer->bytes + begin, writer->bytes + writer->size, NULL};
    const Settings *s = &w->opening.settings;

    for (size_t i = 0; i < o->arrays; i++) {
        o->seen[i] = next_array(&reader);
    }
    o->turn.play = &r->play;
    o->turn.rewards = (double *)(void *)next_array(&reader);
    o->turn.terminated = (uint8_t *)next_array(&reader);
    o->turn.truncated = (uint8_t *)next_array(&reader);
    o->turn.seen = o->seen;
    o->turn.seen_sizes = o->seen_sizes;
    o->call = (Call){.inputs = {(const char *)r->input_rows,
                                (ptrdiff_t)(s->count * sizeof(double)), sizeof(double)},
                     .mask = {(const char *)r->ended, 1},
                     .turn = &o->turn};
    if (!makes_observations(r)) {
        o->call.observations = (float *)(void *)o->seen[0];
    }
}

static bool has_bad_action(const Rollout *o) {
    const Play *play = o->turn.play;
    Turn turn = o->turn;

    for (size_t step = 0; step < o->horizon; step++) {
        if (play_has_bad_action(&turn)) {
            return true;
        }
        turn.actions += play->count * play->actions.elements * play->actions.size;
    }
    return false;
}

/* An index outside of a table is told in the place of the troubled instances. */
enum { OUTSIDE = -1 };

static void roll_out(Worker *w, Rolling *r, Rollout *o) {
    Writer writer = {.bytes = NULL};
    bool outside = false;

    write_integer(&writer, 0);
    measure(w, r, o);
    make_room(w, o, &writer);
    settle_rollout(w, r, o, &writer, sizeof(int64_t));
    if (has_bad_action(o)) {
        free(writer.bytes);
        send_error(w, "an action is out of range");
        return;
    }
    pool_enter(&w->pool);
    const size_t troubled = pool_rollout(&w->pool, &o->call, o->horizon, &outside);
    pool_leave(&w->pool);
    worker_report(w);
    const int64_t result = outside ? OUTSIDE : (int64_t)troubled;
    memcpy(writer.bytes, &result, sizeof result);
    send_result(w, &writer);
}

/* Also adds them to the outputs where the rollout begins. Returns NULL if there are none. */
static const double *read_offsets(Worker *w, Reader *reader) {
    const Settings *s = &w->opening.settings;
    size_t number;
    const double *offsets = read_array(reader, sizeof *offsets, &number);

    if (number == 0) {
        return NULL;
    }
    if (number != s->outputs->count) {
        reader_refuse(reader, "the offsets of a rollout differ in number");
        return NULL;
    }
    for (size_t i = 0; i < number * s->count; i++) {
        w->output_values[i] += offsets[i / s->count];
    }
    return offsets;
}

void answer_roll_out(Worker *w, Reader *reader) {
    if (read_flag(reader)) {
        prepare(w, read_block(reader));
    }
    Rolling *r = w->rolling;
    Rollout o = {.horizon = (size_t)read_integer_in(reader, 1, INT32_MAX)};
    if (r == NULL) {
        send_error(w, "what surrounds the steps of a rollout is damaged");
        return;
    }
    const Actions *a = &r->play.actions;
    const Block actions = read_block(reader);
    if (actions.size != o.horizon * w->opening.settings.count * a->elements * a->size) {
        reader_refuse(reader, "the actions of a rollout differ in number");
    }
    o.turn.offsets = read_offsets(w, reader);
    read_values(w, reader, r);
    if (reader->fault != NULL) {
        send_error(w, reader->fault);
        return;
    }
    o.turn.actions = actions.bytes;
    roll_out(w, r, &o);
}
