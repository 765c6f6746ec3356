/* Rollouts: many steps of the instances in one request, programs included.
 *
 * The rows that programs read and write are memory of the other process. So the worker has rows of its
 * own, and their values come with each request. First are the rows of the inputs, of the outputs and
 * of the outputs before a step; then the counts of steps; then the other ones. */

#include <stdlib.h>
#include <string.h>

#include "../play_form.h"
#include "worker.h"

struct Rolling {
    PlayForm form;
    double *inputs, *kept;
    char **others; /* the other rows */
    size_t number_of_others;
    Row *rows; /* all */
    size_t number_of_rows;
    uint8_t *ended;
};

static void rolling_drop(Rolling *r) {
    if (r == NULL) {
        return;
    }
    for (size_t i = 0; i < r->number_of_others; i++) {
        free(r->others[i]);
    }
    free(r->form.play.actions.current);
    free(r->form.play.actions.previous);
    play_drop(&r->form);
    free(r->inputs);
    free(r->kept);
    free(r->others);
    free(r->rows);
    free(r->ended);
    free(r);
}

static void *zeros(size_t size) {
    return memset(memory_for(NULL, size), 0, size);
}

/* Preparing */

static void add_row(Rolling *r, void *data, size_t size) {
    r->rows[r->number_of_rows++] = (Row){.data = data, .size = size};
}

static void add_rows(Rolling *r, double *values, size_t number, size_t count) {
    for (size_t i = 0; i < number; i++) {
        add_row(r, values + i * count, sizeof(double));
    }
}

static void read_rows(Worker *w, Reader *reader, Rolling *r) {
    const Settings *s = &w->opening.settings;
    const size_t in = s->inputs->count, out = s->outputs->count;
    size_t others;
    const int64_t *sizes = read_array(reader, sizeof *sizes, &others);

    r->inputs = zeros(in * s->count * sizeof(double));
    r->kept = zeros(out * s->count * sizeof(double));
    r->ended = zeros(s->count);
    r->rows = zeros((in + 2 * out + 1 + others) * sizeof *r->rows);
    r->others = zeros(others * sizeof *r->others);
    add_rows(r, r->inputs, in, s->count);
    add_rows(r, w->output_values, out, s->count);
    add_rows(r, r->kept, out, s->count);
    add_row(r, w->shared.progress, sizeof(int64_t));
    for (size_t i = 0; i < others && reader->fault == NULL; i++) {
        if (sizes[i] != 1 && sizes[i] != 4 && sizes[i] != 8) {
            reader_refuse(reader, "there are no values of this size");
            break;
        }
        /* a program may take a row for one of wider values */
        char *row = zeros(s->count * (size_t)sizes[i] + PROGRAM_WIDTH * sizeof(double));
        r->others[r->number_of_others++] = row;
        add_row(r, row, (size_t)sizes[i]);
    }
}

static void prepare(Worker *w, Reader *reader) {
    const Settings *s = &w->opening.settings;
    Rolling *r = zeros(sizeof *r);

    rolling_drop(w->rolling);
    w->rolling = r;
    read_rows(w, reader, r);
    const Block form = read_block(reader);
    if (reader->fault != NULL ||
        play_take(&r->form, s, form.bytes, form.size, r->rows, r->number_of_rows) != NULL) {
        rolling_drop(r);
        w->rolling = NULL;
        return;
    }
    Actions *actions = &r->form.play.actions;
    if (r->form.keeps_actions) {
        actions->current = zeros(s->count * actions->elements * actions->size);
        actions->previous = zeros(s->count * actions->elements * actions->size);
    }
    play_settle(&r->form, s, r->inputs, r->kept, w->shared.progress, r->ended);
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
    const Actions *a = &r->form.play.actions;

    for (size_t i = 0; i < s->inputs->count; i++) {
        memcpy(r->inputs + i * s->count, w->shared.inputs + i * w->shared.stride,
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
    return r->form.judgement.program.number_of_seen > 0;
}

static void measure(Worker *w, Rolling *r, Rollout *o) {
    o->arrays = makes_observations(r) ? r->form.judgement.program.number_of_seen : 1;
    for (size_t i = 0; i < o->arrays; i++) {
        o->seen_sizes[i] = makes_observations(r)
                               ? r->form.judgement.seen_sizes[i]
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
    o->turn.play = &r->form.play;
    o->turn.rewards = (double *)(void *)next_array(&reader);
    o->turn.terminated = (uint8_t *)next_array(&reader);
    o->turn.truncated = (uint8_t *)next_array(&reader);
    o->turn.seen = o->seen;
    o->turn.seen_sizes = o->seen_sizes;
    o->call = (Call){.inputs = {(const char *)r->inputs,
                                (ptrdiff_t)(s->count * sizeof(double)), sizeof(double)},
                     .mask = {(const char *)r->ended, 1},
                     .turn = &o->turn};
    if (!makes_observations(r)) {
        o->call.observations = (float *)(void *)o->seen[0];
    }
}

/* An index outside of a table is told in the place of the troubled instances. */
enum { OUTSIDE = -1 };

static Answer roll_out(Worker *w, Rolling *r, Rollout *o, Writer *writer) {
    bool outside = false;

    write_integer(writer, 0);
    measure(w, r, o);
    make_room(w, o, writer);
    if (writer->failed) {
        return answer_refusal(writer, "out of memory");
    }
    settle_rollout(w, r, o, writer, sizeof(int64_t));
    if (play_has_bad_action(&o->turn, o->horizon)) {
        return answer_refusal(writer, "an action is out of range");
    }
    const size_t troubled = pool_rollout(&w->pool, &o->call, o->horizon, &outside);
    const int64_t result = outside ? OUTSIDE : (int64_t)troubled;
    memcpy(writer->bytes, &result, sizeof result);
    return ANSWER_RESULT;
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

Answer answer_roll_out(Worker *w, Reader *reader, Writer *writer) {
    if (read_flag(reader)) {
        prepare(w, reader);
    }
    Rolling *r = w->rolling;
    Rollout o = {.horizon = (size_t)read_integer_in(reader, 1, INT32_MAX)};
    if (r == NULL) {
        return answer_refusal(writer, "what surrounds the steps of a rollout is damaged");
    }
    const Actions *a = &r->form.play.actions;
    const Block actions = read_block(reader);
    if (actions.size != o.horizon * w->opening.settings.count * a->elements * a->size) {
        reader_refuse(reader, "the actions of a rollout differ in number");
    }
    o.turn.offsets = read_offsets(w, reader);
    read_values(w, reader, r);
    if (reader->fault != NULL) {
        return answer_refusal(writer, reader->fault);
    }
    o.turn.actions = actions.bytes;
    return roll_out(w, r, &o, writer);
}
