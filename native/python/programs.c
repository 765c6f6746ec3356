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

static bool take_row(PyProgram *p, PyObject *object, Py_ssize_t count, Row *row) {
    Py_buffer *buffer = &p->buffers[p->number_of_buffers++];

    if (!take_numbers(object, buffer, true, "a row of a program", count)) {
        return false;
    }
    if ((uintptr_t)buffer->buf % (uintptr_t)buffer->itemsize != 0) {
        PyErr_SetString(PyExc_ValueError, "a row of a program is not aligned");
        return false;
    }
    *row = (Row){.data = buffer->buf, .size = (size_t)buffer->itemsize};
    return true;
}

static bool accept(const char *fault) {
    if (fault != NULL) {
        PyErr_Format(PyExc_ValueError, "a program is not sound: %s", fault);
    }
    return fault == NULL;
}

static bool take_rows(PyProgram *p, PyObject *rows, Py_ssize_t count, size_t action_elements) {
    const size_t number = (size_t)PyTuple_Size(rows);
    Row *taken = calloc(number + 1, sizeof *taken);

    p->buffers = calloc(number + 1, sizeof *p->buffers);
    bool good = taken != NULL && p->buffers != NULL;
    if (!good) {
        PyErr_NoMemory();
    }
    for (size_t i = 0; i < number && good; i++) {
        good = take_row(p, PyTuple_GetItem(rows, (Py_ssize_t)i), count, &taken[i]);
    }
    good = good && accept(program_settle(&p->form, taken, action_elements));
    free(taken);
    return good;
}

bool take_program(PyObject *parts, Py_ssize_t count, size_t action_elements, PyProgram *p) {
    const char *form;
    Py_ssize_t size;
    PyObject *rows;

    if (!PyArg_ParseTuple(parts, "y#O!;a program", &form, &size, &PyTuple_Type, &rows) ||
        !accept(program_take(&p->form, form, (size_t)size, (size_t)PyTuple_Size(rows))) ||
        !take_rows(p, rows, count, action_elements)) {
        return false;
    }
    for (size_t i = 0; i < MOST_SEEN; i++) {
        p->seen_bytes[i] = count * (Py_ssize_t)p->form.seen_sizes[i];
    }
    return true;
}

void release_program(PyProgram *p) {
    for (size_t i = 0; i < p->number_of_buffers; i++) {
        release_buffer(&p->buffers[i]);
    }
    free(p->buffers);
    program_drop(&p->form);
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

    for (size_t i = 0; good && i < program->form.program.number_of_seen; i++) {
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
    const size_t count = program->form.program.number_of_seen;
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
    const size_t wanted = e->program.form.program.number_of_results;

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
    const Program *program = &e->program.form.program;
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
