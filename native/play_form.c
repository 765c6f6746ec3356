/* Reader of the form of a play. */

#include "play_form.h"

#include <stdlib.h>
#include <string.h>

typedef struct {
    const Row *rows;
    size_t count;
} Rows;

static Row row_of(Reader *reader, const Rows *rows, int64_t number) {
    if (number < 0 || (uint64_t)number >= rows->count) {
        reader_refuse(reader, "there is no such row");
        return (Row){.data = NULL};
    }
    return rows->rows[number];
}

static void read_actions(Reader *reader, PlayForm *p) {
    Actions *a = &p->play.actions;

    a->elements = (size_t)read_integer_in(reader, 0, UINT16_MAX);
    a->size = (size_t)read_integer_in(reader, 1, 8);
    a->check = (ActionCheck)read_integer_in(reader, ACTIONS_ANY, ACTIONS_FLOAT32);
    a->lowest = read_integer(reader);
    a->highest = read_integer(reader);
    const Block none = read_block(reader);
    const size_t checked = a->check == ACTIONS_ANY ? a->size : a->check == ACTIONS_FLOAT32 ? 4 : 8;
    if (none.size != a->elements * a->size || a->size != checked) {
        reader_refuse(reader, "actions differ in type");
    }
    a->none = none.bytes;
}

static RowCopies read_copies(Reader *reader, RowCopy **memory, const Rows *rows) {
    size_t count;
    const int64_t *pairs = read_array(reader, 2 * sizeof *pairs, &count);
    RowCopy *copies = *memory = reader_room(reader, count, sizeof *copies);

    for (size_t i = 0; i < count && reader->fault == NULL; i++, pairs += 2) {
        copies[i] = (RowCopy){row_of(reader, rows, pairs[0]), row_of(reader, rows, pairs[1])};
        if (copies[i].from.size != copies[i].to.size || copies[i].from.stride != 1 ||
            copies[i].to.stride != 1) {
            reader_refuse(reader, "rows to copy differ in type, or have gaps");
        }
    }
    return (RowCopies){copies, count};
}

static RowStart read_start(Reader *reader, const Play *play, const Rows *rows,
                           const int64_t *numbers) {
    RowStart start = {.to = row_of(reader, rows, numbers[0]), .kind = START_CONSTANT};
    const size_t draws = play->draws == NULL ? 0 : play->draws->count;
    bool fits = true;

    if (numbers[1] == START_CONSTANT) {
        start.from.bits = (uint64_t)numbers[2];
    } else if (numbers[1] == START_ROW) {
        const Row from = row_of(reader, rows, numbers[2]);
        start.kind = START_ROW;
        start.from.row = from.data;
        fits = from.size == start.to.size && from.stride == 1;
    } else {
        start.kind = START_DRAW;
        start.from.draw = (size_t)numbers[2];
        fits = numbers[1] == START_DRAW && start.to.size == sizeof(double) &&
               (uint64_t)numbers[2] < draws;
    }
    if (!fits || start.to.stride != 1) {
        reader_refuse(reader, "a row and its start differ in type, or there is no such draw");
    }
    return start;
}

/* For each a row, a kind, and a number: bits of a constant, a row or a draw. */
static void read_starts(Reader *reader, PlayForm *p, const Rows *rows) {
    size_t count;
    const int64_t *numbers = read_array(reader, 3 * sizeof *numbers, &count);

    p->starts = reader_room(reader, count, sizeof *p->starts);
    p->play.starts = p->starts;
    p->play.number_of_starts = count;
    for (size_t i = 0; i < count && reader->fault == NULL; i++) {
        p->starts[i] = read_start(reader, &p->play, rows, numbers + 3 * i);
    }
}

static void read_program(Reader *reader, ProgramForm *program, const Rows *rows) {
    const Block form = read_block(reader);
    size_t count;
    const int64_t *numbers = read_array(reader, sizeof *numbers, &count);
    Row *own = reader_room(reader, count, sizeof *own);

    for (size_t i = 0; i < count && reader->fault == NULL; i++) {
        own[i] = row_of(reader, rows, numbers[i]);
    }
    const char *fault = reader->fault;
    fault = fault == NULL ? program_take(program, form.bytes, form.size, count) : fault;
    fault = fault == NULL ? program_settle(program, own) : fault;
    if (fault != NULL) {
        reader_refuse(reader, fault);
    }
    free(own);
}

const char *play_take(PlayForm *p, const Settings *s, const void *form, size_t size,
                      const Row *rows, size_t number_of_rows) {
    const Rows all = {rows, number_of_rows};

    p->form = form_copy(form, size);
    if (p->form == NULL) {
        return form_no_memory;
    }
    Reader reader = {p->form, p->form + size, NULL};
    p->play.count = s->count;
    p->play.reads_kept = read_flag(&reader);
    p->play.limit = read_integer(&reader);
    read_actions(&reader, p);
    p->play.before_inputs = read_copies(&reader, &p->before_inputs, &all);
    p->play.before_conclusion = read_copies(&reader, &p->before_conclusion, &all);
    read_starts(&reader, p, &all);
    read_program(&reader, &p->inputs, &all);
    read_program(&reader, &p->conclusion, &all);
    if (reader.at != reader.end || p->inputs.program.number_of_seen > 0 ||
        p->conclusion.program.number_of_results != PROGRAM_RESULTS) {
        reader_refuse(&reader, "a program does not fit the pool");
    }
    return reader.fault;
}

/* Notes which rows are those of the outputs, as long as the program only reads them. */
static void note_outputs(ProgramForm *p, const Settings *s) {
    for (size_t i = 0; i < p->program.number_of_rows; i++) {
        Row *row = &p->rows[i];
        for (uint32_t k = 0; k < s->outputs->count && !row->changes; k++) {
            if (row->data == (const char *)(s->output_values + k * s->count)) {
                row->output = k + 1;
            }
        }
    }
}

void play_settle(PlayForm *p, const Settings *s, double *kept, int64_t *step_counts,
                 uint8_t *ended) {
    Play *play = &p->play;

    note_outputs(&p->conclusion, s);
    play->inputs = p->inputs.program;
    play->conclusion = p->conclusion.program;
    play->source.statuses = s->status;
    play->output_rows = s->output_values;
    play->number_of_outputs = s->outputs->count;
    play->kept_rows = kept;
    play->step_counts = step_counts;
    play->ended = ended;
}

void play_drop(PlayForm *p) {
    program_drop(&p->inputs);
    program_drop(&p->conclusion);
    free(p->before_inputs);
    free(p->before_conclusion);
    free(p->starts);
    free(p->form);
}
