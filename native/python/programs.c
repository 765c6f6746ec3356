#include "programs.h"

#include <stdlib.h>
#include <string.h>

bool take_numbers(PyObject *object, Py_buffer *buffer, bool written, const char *name,
                  Py_ssize_t length) {
    const int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (written ? PyBUF_WRITABLE : 0);

    if (PyObject_GetBuffer(object, buffer, flags) < 0) {
        return false;
    }
    if (buffer->ndim == 1 && buffer->shape[0] == length && buffer->itemsize <= 8) {
        return true;
    }
    PyErr_Format(PyExc_ValueError, "%s must be a vector of %zd numbers", name, length);
    return false;
}

static bool take_rows(PyProgram *p, PyObject *rows, Py_ssize_t count) {
    for (Py_ssize_t i = 0; i < PyTuple_Size(rows); i++) {
        Py_buffer *buffer = &p->buffers[p->number_of_buffers++];
        if (!take_numbers(PyTuple_GetItem(rows, i), buffer, true, "a row of a program", count)) {
            return false;
        }
        if ((uintptr_t)buffer->buf % (uintptr_t)buffer->itemsize != 0) {
            PyErr_SetString(PyExc_ValueError, "a row of a program is not aligned");
            return false;
        }
        p->rows[i] = (Row){.data = buffer->buf, .size = (size_t)buffer->itemsize};
    }
    return true;
}

static bool take_tables(PyProgram *p, PyObject *tables) {
    for (Py_ssize_t i = 0; i < PyTuple_Size(tables); i++) {
        PyObject *table = PyTuple_GetItem(tables, i);
        const Py_ssize_t length = PyObject_Length(table);
        Py_buffer *buffer = &p->buffers[p->number_of_buffers++];
        if (length < 0 || !take_numbers(table, buffer, false, "a table of a program", length)) {
            return false;
        }
        p->tables[i] = (Table){.data = buffer->buf,
                               .length = (size_t)length,
                               .size = (size_t)buffer->itemsize};
    }
    return true;
}

/* Reads how large the arrays of observations must be. */
static bool measure_seen(PyProgram *p, Py_ssize_t count) {
    static const Py_ssize_t sizes[VALUE_TYPES] = {8, 4, 8, 1, 1};

    for (size_t i = 0; i < p->program.number_of_slots; i++) {
        const Slot *slot = &p->program.slots[i];
        if (slot->array >= MOST_SEEN || slot->type >= VALUE_TYPES) {
            return false;
        }
        const Py_ssize_t bytes = count * (Py_ssize_t)slot->elements * sizes[slot->type];
        Py_ssize_t *known = &p->seen_bytes[slot->array];
        if (*known != 0 && *known != bytes) {
            return false;
        }
        *known = bytes;
    }
    return true;
}

typedef struct {
    PyObject *rows, *tables;
    const char *code, *constants, *slots;
    Py_ssize_t code_size, constants_size, slots_size, registers, seen;
    PyObject *results;
} Parts;

static bool parse(PyObject *parts, Parts *found) {
    return PyArg_ParseTuple(
        parts, "y#y#y#O!O!nnO!;a program", &found->code, &found->code_size, &found->constants,
        &found->constants_size, &found->slots, &found->slots_size, &PyTuple_Type, &found->rows,
        &PyTuple_Type, &found->tables, &found->registers, &found->seen, &PyTuple_Type,
        &found->results);
}

static bool take_results(Program *program, PyObject *results) {
    const Py_ssize_t count = PyTuple_Size(results);

    for (Py_ssize_t i = 0; i < count && i < PROGRAM_RESULTS; i++) {
        const long number = PyLong_AsLong(PyTuple_GetItem(results, i));
        if (number < 0 || number >= PROGRAM_REGISTERS) {
            return false;
        }
        program->results[i] = (uint16_t)number;
    }
    program->number_of_results = (size_t)count;
    return count <= PROGRAM_RESULTS;
}

static bool allocate(PyProgram *p, const Parts *parts) {
    const size_t rows = (size_t)PyTuple_Size(parts->rows);
    const size_t tables = (size_t)PyTuple_Size(parts->tables);

    p->buffers = calloc(rows + tables + 1, sizeof *p->buffers);
    p->rows = calloc(rows + 1, sizeof *p->rows);
    p->tables = calloc(tables + 1, sizeof *p->tables);
    p->filled = malloc(((size_t)parts->constants_size / sizeof(Constant) + 1) * sizeof(Register));
    p->program = (Program){
        .code = (const Instruction *)(const void *)parts->code,
        .constants = (const Constant *)(const void *)parts->constants,
        .slots = (const Slot *)(const void *)parts->slots,
        .rows = p->rows,
        .tables = p->tables,
        .length = (size_t)parts->code_size / sizeof(Instruction),
        .number_of_constants = (size_t)parts->constants_size / sizeof(Constant),
        .number_of_slots = (size_t)parts->slots_size / sizeof(Slot),
        .number_of_rows = rows,
        .number_of_tables = tables,
        .number_of_seen = (size_t)parts->seen,
        .registers = (size_t)parts->registers,
    };
    if (p->buffers == NULL || p->rows == NULL || p->tables == NULL || p->filled == NULL) {
        PyErr_NoMemory();
        return false;
    }
    return true;
}

static bool is_sound(PyProgram *p, const Parts *parts, Py_ssize_t count, size_t action_elements) {
    const bool sound = parts->code_size % (Py_ssize_t)sizeof(Instruction) == 0 &&
                       parts->constants_size % (Py_ssize_t)sizeof(Constant) == 0 &&
                       parts->slots_size % (Py_ssize_t)sizeof(Slot) == 0 && parts->seen >= 0 &&
                       parts->seen <= MOST_SEEN && parts->registers >= 0 &&
                       take_results(&p->program, parts->results) && measure_seen(p, count) &&
                       program_is_sound(&p->program, action_elements);
    if (!sound && !PyErr_Occurred()) {
        PyErr_SetString(PyExc_ValueError, "a program is not sound");
    }
    return sound;
}

/* The constants' registers begin at the first place in their memory that is aligned. */
static void fill_constants(PyProgram *p) {
    const size_t alignment = _Alignof(Register);
    const size_t past = (size_t)((uintptr_t)p->filled % alignment);
    Register *filled = (Register *)(void *)(p->filled + (past == 0 ? 0 : alignment - past));

    for (size_t i = 0; i < p->program.number_of_constants; i++) {
        program_fill(&p->program.constants[i], &filled[i]);
    }
    p->program.filled = filled;
}

/* Two rows may be the same memory. */
static void note_change(PyProgram *p, const char *changed) {
    for (size_t i = 0; i < p->program.number_of_rows; i++) {
        p->rows[i].changes |= p->rows[i].data == changed;
    }
}

static void note_changes(PyProgram *p) {
    for (size_t i = 0; i < p->program.length; i++) {
        if (p->program.code[i].operation == STORE_ROW) {
            note_change(p, p->rows[p->program.code[i].extra].data);
        }
    }
}

bool take_program(PyObject *parts, Py_ssize_t count, size_t action_elements, PyProgram *program) {
    Parts found;

    if (!PyTuple_Check(parts)) {
        PyErr_SetString(PyExc_TypeError, "a program must be a tuple");
        return false;
    }
    Py_INCREF(parts);
    program->parts = parts;
    if (!parse(parts, &found) || !allocate(program, &found) ||
        !take_rows(program, found.rows, count) || !take_tables(program, found.tables) ||
        !is_sound(program, &found, count, action_elements)) {
        return false;
    }
    fill_constants(program);
    note_changes(program);
    return true;
}

void release_program(PyProgram *program) {
    for (size_t i = 0; i < program->number_of_buffers; i++) {
        release_buffer(&program->buffers[i]);
    }
    free(program->buffers);
    free(program->rows);
    free(program->tables);
    free(program->filled);
    Py_XDECREF(program->parts);
}

static bool take_one_seen(const PyProgram *program, size_t i, PyObject *array, Py_buffer *buffers,
                          char **seen) {
    if (PyObject_GetBuffer(array, &buffers[i], PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) < 0) {
        return false;
    }
    if (buffers[i].len != program->seen_bytes[i]) {
        PyErr_Format(PyExc_ValueError, "an array of observations has %zd bytes, expected %zd",
                     buffers[i].len, program->seen_bytes[i]);
        return false;
    }
    seen[i] = buffers[i].buf;
    return true;
}

/* Takes the arrays in a tuple or a dict. Its values come in the order in which they were set. */
static bool take_each_seen(const PyProgram *program, PyObject *arrays, Py_buffer *buffers,
                           char **seen) {
    const bool is_dict = PyDict_Check(arrays);
    PyObject *array = NULL;
    Py_ssize_t place = 0;
    bool good = true;

    for (size_t i = 0; good && i < program->program.number_of_seen; i++) {
        if (!is_dict) {
            array = PyTuple_GetItem(arrays, (Py_ssize_t)i);
        } else if (!PyDict_Next(arrays, &place, NULL, &array)) {
            return false; /* its size has been checked */
        }
        good = take_one_seen(program, i, array, buffers, seen);
    }
    return good;
}

bool take_seen(const PyProgram *program, PyObject *arrays, Py_buffer *buffers, char **seen) {
    const size_t count = program->program.number_of_seen;
    const bool is_dict = PyDict_Check(arrays), is_tuple = PyTuple_Check(arrays);

    if (count == 1 && !is_tuple && !is_dict) {
        return take_one_seen(program, 0, arrays, buffers, seen);
    }
    if ((!is_dict && !is_tuple) || (size_t)PyObject_Size(arrays) != count) {
        PyErr_Format(PyExc_TypeError, "there must be a tuple of %zu arrays of observations", count);
        return false;
    }
    return take_each_seen(program, arrays, buffers, seen);
}

/* Evaluating a program alone */

enum { ACTIONS_GIVEN, PREVIOUS_GIVEN, FIRST_RESULT, FIRST_SEEN = FIRST_RESULT + PROGRAM_RESULTS };

typedef struct {
    PyProgram program;
    Py_buffer buffers[FIRST_SEEN + MOST_SEEN];
    Source source;
    char *seen[MOST_SEEN];
    size_t count;
} Evaluation;

static bool take_given(Evaluation *e, PyObject *actions, PyObject *previous) {
    Py_buffer *b = e->buffers;
    const Py_ssize_t length = (Py_ssize_t)(e->count * e->source.action_elements);

    if (!take_numbers(actions, &b[ACTIONS_GIVEN], false, "actions", length) ||
        !take_numbers(previous, &b[PREVIOUS_GIVEN], false, "previous actions", length)) {
        return false;
    }
    e->source.actions = b[ACTIONS_GIVEN].buf;
    e->source.previous_actions = b[PREVIOUS_GIVEN].buf;
    e->source.action_size = (size_t)b[ACTIONS_GIVEN].itemsize;
    if (b[PREVIOUS_GIVEN].itemsize != b[ACTIONS_GIVEN].itemsize) {
        PyErr_SetString(PyExc_ValueError, "actions and previous actions differ in type");
        return false;
    }
    return true;
}

static bool take_outputs(Evaluation *e, PyObject *results, PyObject *seen) {
    const size_t wanted = e->program.program.number_of_results;

    if ((size_t)PyTuple_Size(results) != wanted) {
        PyErr_SetString(PyExc_ValueError, "there must be an array for each result");
        return false;
    }
    for (size_t i = 0; i < wanted; i++) {
        if (!take_numbers(PyTuple_GetItem(results, (Py_ssize_t)i), &e->buffers[FIRST_RESULT + i],
                          true, "a result", (Py_ssize_t)e->count)) {
            return false;
        }
    }
    e->source.seen = e->seen;
    return take_seen(&e->program, seen, &e->buffers[FIRST_SEEN], e->seen);
}

static bool evaluate(Evaluation *e) {
    const Program *program = &e->program.program;
    Register memory[PROGRAM_REGISTERS];
    Registers registers;
    Notes notes = {.outside = false};

    program_prepare(program, memory, &registers);
    for (size_t begin = 0; begin < e->count; begin += PROGRAM_WIDTH) {
        const size_t rest = e->count - begin;
        const size_t count = rest < PROGRAM_WIDTH ? rest : PROGRAM_WIDTH;
        program_run(program, &e->source, begin, count, &registers, &notes);
        for (size_t i = 0; i < program->number_of_results; i++) {
            const Py_buffer *b = &e->buffers[FIRST_RESULT + i];
            const size_t size = (size_t)b->itemsize;
            memcpy((char *)b->buf + begin * size, registers.places[program->results[i]],
                   count * size);
        }
    }
    return notes.outside;
}

PyObject *py_evaluate(PyObject *module, PyObject *args) {
    PyObject *parts, *actions, *previous, *results, *seen, *result = NULL;
    Py_ssize_t count, elements;
    Evaluation *e = calloc(1, sizeof *e);

    (void)module;
    if (e == NULL) {
        return PyErr_NoMemory();
    }
    if (PyArg_ParseTuple(args, "OnnOOO!O!:evaluate", &parts, &count, &elements, &actions,
                         &previous, &PyTuple_Type, &results, &PyTuple_Type, &seen)) {
        e->count = (size_t)count;
        e->source.action_elements = (size_t)elements;
        if (take_program(parts, count, (size_t)elements, &e->program) &&
            take_given(e, actions, previous) && take_outputs(e, results, seen)) {
            result = PyBool_FromLong(evaluate(e));
        }
    }
    for (int i = 0; i < FIRST_SEEN + MOST_SEEN; i++) {
        release_buffer(&e->buffers[i]);
    }
    release_program(&e->program);
    free(e);
    return result;
}
