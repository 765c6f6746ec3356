/* Reader of the forms of programs, and of draws. */

#include "program/program_form.h"

#include <stdlib.h>
#include <string.h>

bool read_draws(Reader *reader, Draws *draws) {
    size_t numbers;

    draws->draws = read_array(reader, sizeof(Draw), &draws->count);
    draws->numbers = read_array(reader, sizeof(double), &numbers);
    return reader_require(reader, reader->at == reader->end, form_truncated) &&
           reader_require(reader, draws_are_sound(draws, numbers),
                   "the numbers do not fit the kinds of distributions");
}

static const char UNSOUND[] = "its parts do not fit together";

static void read_tables(Reader *reader, ProgramForm *p) {
    const size_t count = p->program.number_of_tables = read_count(reader);

    p->tables = reader_room(reader, count, sizeof *p->tables);
    for (size_t i = 0; i < count && reader->fault == NULL; i++) {
        Table *table = &p->tables[i];
        table->size = (size_t)read_integer_in(reader, 1, 8);
        table->data = read_array(reader, table->size, &table->length);
    }
    p->program.tables = p->tables;
}

const char *program_take(ProgramForm *p, const void *form, size_t size, size_t number_of_rows) {
    Program *program = &p->program;

    memset(p, 0, sizeof *p);
    p->form = form_copy(form, size);
    if (p->form == NULL) {
        return form_no_memory;
    }
    Reader reader = {p->form, p->form + size, NULL};
    program->registers = (size_t)read_integer_in(&reader, 0, PROGRAM_REGISTERS);
    program->code = read_array(&reader, sizeof(Instruction), &program->length);
    program->constants = read_array(&reader, sizeof(Constant), &program->number_of_constants);
    program->rows = p->rows = reader_room(&reader, number_of_rows, sizeof *p->rows);
    program->number_of_rows = number_of_rows;
    read_tables(&reader, p);
    reader_require(&reader, reader.at == reader.end, form_truncated);
    return reader.fault;
}

/* The constants' registers begin at the first place in their memory that is aligned. */
static bool fill_constants(ProgramForm *p) {
    const size_t alignment = _Alignof(Register);

    p->filled = malloc((p->program.number_of_constants + 1) * sizeof(Register));
    const size_t past = (size_t)((uintptr_t)p->filled % alignment);
    Register *filled = (Register *)(void *)(p->filled + (past == 0 ? 0 : alignment - past));
    for (size_t i = 0; p->filled != NULL && i < p->program.number_of_constants; i++) {
        program_fill(&p->program.constants[i], &filled[i]);
    }
    p->program.filled = filled;
    return p->filled != NULL;
}

/* Two rows may be the same memory. */
static void note_changes(ProgramForm *p) {
    for (size_t i = 0; i < p->program.length; i++) {
        const Instruction *code = &p->program.code[i];
        const char *stored = code->operation == STORE_ROW ? p->rows[code->extra].data : NULL;
        for (size_t k = 0; stored != NULL && k < p->program.number_of_rows; k++) {
            p->rows[k].changes |= p->rows[k].data == stored;
        }
    }
}

const char *program_settle(ProgramForm *p, const Row *rows) {
    memcpy(p->rows, rows, p->program.number_of_rows * sizeof *rows);
    if (!program_is_sound(&p->program)) {
        return UNSOUND;
    }
    if (!fill_constants(p)) {
        return form_no_memory;
    }
    note_changes(p);
    return NULL;
}

void program_drop(ProgramForm *p) {
    free(p->rows);
    free(p->tables);
    free(p->filled);
    free(p->form);
}
