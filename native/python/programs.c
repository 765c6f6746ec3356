/* Programs, taken over from Python. */

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

/* A row may be an element of an array that has the instances on its first axis. */
static bool take_row(PyObject *object, Py_ssize_t length, Py_buffer *buffer, Row *row) {
    if (PyObject_GetBuffer(object, buffer, PyBUF_STRIDES | PyBUF_FORMAT | PyBUF_WRITABLE) < 0) {
        return false;
    }
    if (buffer->ndim != 1 || buffer->shape[0] != length || buffer->itemsize > 8) {
        PyErr_Format(PyExc_ValueError, "a row of a program must be a vector of %zd numbers", length);
        return false;
    }
    const Py_ssize_t size = buffer->itemsize, stride = length > 1 ? buffer->strides[0] : size;
    if ((uintptr_t)buffer->buf % (uintptr_t)size != 0 || stride < size || stride % size != 0) {
        PyErr_SetString(PyExc_ValueError, "a row of a program is not aligned");
        return false;
    }
    *row = (Row){.data = buffer->buf, .size = (size_t)size, .stride = (size_t)(stride / size)};
    return true;
}

bool take_rows(PyObject *tuple, Py_ssize_t length, PyRows *r) {
    const size_t number = (size_t)PyTuple_Size(tuple);
    bool good = true;

    r->buffers = calloc(number + 1, sizeof *r->buffers);
    r->rows = calloc(number + 1, sizeof *r->rows);
    if (r->buffers == NULL || r->rows == NULL) {
        PyErr_NoMemory();
        return false;
    }
    for (; good && r->count < number; r->count++) {
        good = take_row(PyTuple_GetItem(tuple, (Py_ssize_t)r->count), length,
                        &r->buffers[r->count], &r->rows[r->count]);
    }
    return good;
}

void release_rows(PyRows *r) {
    for (size_t i = 0; i < r->count; i++) {
        release_buffer(&r->buffers[i]);
    }
    free(r->buffers);
    free(r->rows);
}

static bool take_one_seen(const ProgramForm *program, size_t count, size_t i, PyObject *array,
                          Py_buffer *buffers, char **seen) {
    const Py_ssize_t size = (Py_ssize_t)(count * program->seen_sizes[i]);

    if (PyObject_GetBuffer(array, &buffers[i], PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) < 0) {
        return false;
    }
    if (buffers[i].len != size) {
        PyErr_Format(PyExc_ValueError, "an array of observations has %zd bytes, expected %zd",
                     buffers[i].len, size);
        return false;
    }
    seen[i] = buffers[i].buf;
    return true;
}

/* Takes the arrays in a tuple or a dict. Its values come in the order in which they were set. */
static bool take_each_seen(const ProgramForm *program, size_t count, PyObject *arrays,
                           Py_buffer *buffers, char **seen) {
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
        good = take_one_seen(program, count, i, array, buffers, seen);
    }
    return good;
}

bool take_seen(const ProgramForm *program, size_t count, PyObject *arrays, Py_buffer *buffers,
               char **seen) {
    const size_t number = program->program.number_of_seen;
    const bool is_dict = PyDict_Check(arrays), is_tuple = PyTuple_Check(arrays);

    if (number == 1 && !is_tuple && !is_dict) {
        return take_one_seen(program, count, 0, arrays, buffers, seen);
    }
    if ((!is_dict && !is_tuple) || (size_t)PyObject_Size(arrays) != number) {
        PyErr_Format(PyExc_TypeError, "there must be a tuple of %zu arrays of observations",
                     number);
        return false;
    }
    return take_each_seen(program, count, arrays, buffers, seen);
}

/* Evaluating a program alone */

enum { FIRST_SEEN = PROGRAM_RESULTS }; /* among buffers; those of results come first */

typedef struct {
    ProgramForm program;
    PyRows rows;
    Py_buffer buffers[FIRST_SEEN + MOST_SEEN];
    Source source;
    char *seen[MOST_SEEN];
    size_t count;
} Evaluation;

static bool take_program(Evaluation *e, PyObject *parts) {
    const char *form;
    Py_ssize_t size;
    PyObject *rows;

    if (!PyArg_ParseTuple(parts, "y#O!;a program", &form, &size, &PyTuple_Type, &rows) ||
        !take_rows(rows, (Py_ssize_t)e->count, &e->rows)) {
        return false;
    }
    const char *fault = program_take(&e->program, form, (size_t)size, e->rows.count);
    if (fault == NULL) {
        fault = program_settle(&e->program, e->rows.rows);
    }
    if (fault != NULL) {
        PyErr_Format(PyExc_ValueError, "a program is not sound: %s", fault);
    }
    return fault == NULL;
}

static bool take_outputs(Evaluation *e, PyObject *results, PyObject *seen) {
    const size_t wanted = e->program.program.number_of_results;

    if ((size_t)PyTuple_Size(results) != wanted) {
        PyErr_SetString(PyExc_ValueError, "there must be an array for each result");
        return false;
    }
    for (size_t i = 0; i < wanted; i++) {
        if (!take_numbers(PyTuple_GetItem(results, (Py_ssize_t)i), &e->buffers[i],
                          true, "a result", (Py_ssize_t)e->count)) {
            return false;
        }
    }
    e->source.seen = e->seen;
    return take_seen(&e->program, e->count, seen, &e->buffers[FIRST_SEEN], e->seen);
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
            const Py_buffer *b = &e->buffers[i];
            const size_t size = (size_t)b->itemsize;
            memcpy((char *)b->buf + begin * size, registers.places[program->results[i]],
                   count * size);
        }
    }
    return notes.outside;
}

PyObject *py_evaluate(PyObject *module, PyObject *args) {
    PyObject *parts, *results, *seen, *result = NULL;
    Py_ssize_t count;
    Evaluation *e = calloc(1, sizeof *e);

    (void)module;
    if (e == NULL) {
        return PyErr_NoMemory();
    }
    if (PyArg_ParseTuple(args, "OnO!O!:evaluate", &parts, &count, &PyTuple_Type, &results,
                         &PyTuple_Type, &seen)) {
        e->count = (size_t)count;
        if (take_program(e, parts) && take_outputs(e, results, seen)) {
            result = PyBool_FromLong(evaluate(e));
        }
    }
    for (int i = 0; i < FIRST_SEEN + MOST_SEEN; i++) {
        release_buffer(&e->buffers[i]);
    }
    release_rows(&e->rows);
    program_drop(&e->program);
    free(e);
    return result;
}
