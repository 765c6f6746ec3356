/* Programs, taken over from Python. */

#include "python/programs.h"

#include <stdlib.h>
#include <string.h>

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

/* Evaluating a program alone */

typedef struct {
    ProgramForm program;
    PyRows rows;
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

static bool evaluate(const Evaluation *e) {
    static const Source source;
    const Program *program = &e->program.program;
    Register memory[PROGRAM_REGISTERS];
    Registers registers;
    Notes notes = {.outside = false};

    program_prepare(program, memory, &registers);
    for (size_t begin = 0; begin < e->count; begin += PROGRAM_WIDTH) {
        const size_t rest = e->count - begin;
        const size_t count = rest < PROGRAM_WIDTH ? rest : PROGRAM_WIDTH;
        program_run(program, &source, begin, count, &registers, &notes);
    }
    return notes.outside;
}

PyObject *py_evaluate(PyObject *module, PyObject *args) {
    PyObject *parts, *result = NULL;
    Py_ssize_t count;
    Evaluation *e = calloc(1, sizeof *e);

    (void)module;
    if (e == NULL) {
        return PyErr_NoMemory();
    }
    if (PyArg_ParseTuple(args, "On:evaluate", &parts, &count)) {
        e->count = (size_t)count;
        if (take_program(e, parts)) {
            result = PyBool_FromLong(evaluate(e));
        }
    }
    release_rows(&e->rows);
    program_drop(&e->program);
    free(e);
    return result;
}
