/* Reader of the form of a play. */

#include "pool/play_form.h"

#include <stdlib.h>
#include <string.h>

/* The rows that a form names by numbers: those of memory that stays, and, by -1 and less, those in
 * arrays of a call. */
typedef struct {
    const Row *rows;
    size_t count;
    const int64_t *stored; /* for each: array, element, elements of one environment, type */
    size_t number_of_stored;
    size_t number_of_arrays; /* in which a program may store */
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

enum { LARGEST = 1 << 24 /* elements of one environment in an array */ };

/* A row in an array of a call; notes how large this must be. */
static Row stored_row(Reader *reader, PlayForm *p, size_t arrays, const int64_t *numbers) {
    static const size_t sizes[VALUE_TYPES] = {8, 4, 8, 1, 1};
    const uint64_t array = (uint64_t)numbers[0], element = (uint64_t)numbers[1],
                   elements = (uint64_t)numbers[2], type = (uint64_t)numbers[3];

    if (array >= arrays || elements > LARGEST || element >= elements || type >= VALUE_TYPES) {
        reader_refuse(reader, "there is no such element of an array");
        return (Row){.data = NULL};
    }
    const size_t size = sizes[type];
    if (p->play.array_sizes[array] != 0 && p->play.array_sizes[array] != elements * size) {
        reader_refuse(reader, "elements of an array differ in type");
    }
    p->play.array_sizes[array] = elements * size;
    return (Row){.array = array,
                 .offset = element * size,
                 .size = size,
                 .stride = elements,
                 .type = (uint32_t)type};
}

static Row row_of_program(Reader *reader, PlayForm *p, const Rows *rows, int64_t number) {
    const uint64_t place = (uint64_t)(-1 - number);

    if (number >= 0) {
        return row_of(reader, rows, number);
    }
    if (place >= rows->number_of_stored) {
        reader_refuse(reader, "there is no such row");
        return (Row){.data = NULL};
    }
    return stored_row(reader, p, rows->number_of_arrays, rows->stored + 4 * place);
}

static RowStart read_start(Reader *reader, PlayForm *p, const Rows *rows,
                           const int64_t *numbers) {
    RowStart start = {.to = row_of_program(reader, p, rows, numbers[0]), .kind = START_CONSTANT};
    const size_t draws = p->play.draws == NULL ? 0 : p->play.draws->count;
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
static RowStarts read_starts(Reader *reader, PlayForm *p, RowStart **memory, const Rows *rows) {
    size_t count;
    const int64_t *numbers = read_array(reader, 3 * sizeof *numbers, &count);
    RowStart *starts = *memory = reader_room(reader, count, sizeof *starts);

    for (size_t i = 0; i < count && reader->fault == NULL; i++) {
        starts[i] = read_start(reader, p, rows, numbers + 3 * i);
    }
    return (RowStarts){starts, count};
}

static void read_program(Reader *reader, PlayForm *p, ProgramForm *program, const Rows *rows) {
    const Block form = read_block(reader);
    size_t count;
    const int64_t *numbers = read_array(reader, sizeof *numbers, &count);
    Row *own = reader_room(reader, count, sizeof *own);

    for (size_t i = 0; i < count && reader->fault == NULL; i++) {
        own[i] = row_of_program(reader, p, rows, numbers[i]);
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
    Rows all = {.rows = rows, .count = number_of_rows};

    p->form = form_copy(form, size);
    if (p->form == NULL) {
        return form_no_memory;
    }
    Reader reader = {p->form, p->form + size, NULL};
    p->play.count = s->count;
    p->play.reads_kept = read_flag(&reader);
    p->play.number_of_seen = (size_t)read_integer_in(&reader, 0, MOST_ARRAYS);
    read_actions(&reader, p);
    p->play.before_inputs = read_copies(&reader, &p->before_inputs, &all);
    p->play.before_conclusion = read_copies(&reader, &p->before_conclusion, &all);
    p->play.starts = read_starts(&reader, p, &p->starts, &all);
    read_program(&reader, p, &p->inputs, &all); /* it runs without arrays of a call */
    all.stored = read_array(&reader, 4 * sizeof *all.stored, &all.number_of_stored);
    all.number_of_arrays = MOST_ARRAYS;
    read_program(&reader, p, &p->conclusion, &all);
    p->play.unstepped = read_starts(&reader, p, &p->unstepped, &all);
    all.number_of_arrays = p->play.number_of_seen;
    read_program(&reader, p, &p->observation, &all);
    reader_require(&reader, reader.at == reader.end, form_truncated);
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

void play_settle(PlayForm *p, const Settings *s, double *kept, uint8_t *ended) {
    Play *play = &p->play;

    note_outputs(&p->conclusion, s);
    play->inputs = p->inputs.program;
    play->conclusion = p->conclusion.program;
    play->observation = p->observation.program;
    play->source.statuses = s->status;
    play->output_rows = s->output_values;
    play->number_of_outputs = s->outputs->count;
    play->kept_rows = kept;
    play->ended = ended;
    play->number_of_arrays = play->number_of_seen + STEP_ARRAYS;
    p->pool_observes = play->number_of_seen == 1 && play->array_sizes[0] == 0;
    if (p->pool_observes) {
        play->array_sizes[0] = s->num_observed * sizeof(float);
    }
}

void play_drop(PlayForm *p) {
    program_drop(&p->inputs);
    program_drop(&p->conclusion);
    program_drop(&p->observation);
    free(p->before_inputs);
    free(p->before_conclusion);
    free(p->starts);
    free(p->unstepped);
    free(p->form);
}
