/* Programs, taken over from Python: their rows, and the evaluation of one outside of a step. */

#include "python/python.h"

#include <stdlib.h>

/* A row may be an element of an array that has the instances on its first axis. */
static bool take_row(PyArrayObject *array, npy_intp length, Row *row) {
    if (!require_any_array(array, "a row of a program")) {
        return false;
    }
    const npy_intp size = PyArray_ITEMSIZE(array);
    if (PyArray_NDIM(array) != 1 || PyArray_DIM(array, 0) != length || size > 8) {
        PyErr_Format(PyExc_ValueError, "a row of a program must be a vector of %zd numbers", length);
        return false;
    }
    const npy_intp stride = length > 1 ? PyArray_STRIDE(array, 0) : size;
    if (!PyArray_ISBEHAVED(array) || stride < size || stride % size != 0) {
        PyErr_SetString(PyExc_ValueError, "a row of a program is read-only or not aligned");
        return false;
    }
    *row = (Row){.data = PyArray_BYTES(array), .size = (size_t)size,
                 .stride = (size_t)(stride / size)};
    return true;
}

Row *take_rows(PyObject *tuple, npy_intp length) {
    const size_t count = (size_t)PyTuple_Size(tuple);
    Row *rows = calloc(count + 1, sizeof *rows);
    bool good = rows != NULL || PyErr_NoMemory() != NULL;

    for (size_t i = 0; good && i < count; i++) {
        good = take_row((PyArrayObject *)PyTuple_GetItem(tuple, (Py_ssize_t)i), length, &rows[i]);
    }
    if (!good) {
        free(rows);
        return NULL;
    }
    return rows;
}

/* Evaluating a program alone */

static PyObject *evaluate_form(const char *form, size_t size, PyObject *tuple, Py_ssize_t count) {
    Row *rows = take_rows(tuple, count);
    ProgramForm program;

    if (rows == NULL) {
        return NULL;
    }
    const char *fault = program_take(&program, form, size, (size_t)PyTuple_Size(tuple));
    if (fault == NULL) {
        fault = program_settle(&program, rows);
    }
    PyObject *result = require_no_fault("a program", fault)
                           ? PyBool_FromLong(program_evaluate(&program.program, (size_t)count))
                           : NULL;
    program_drop(&program);
    free(rows);
    return result;
}

PyObject *py_evaluate(PyObject *module, PyObject *args) {
    const char *form;
    Py_ssize_t size, count;
    PyObject *rows;

    (void)module;
    return PyArg_ParseTuple(args, "(y#O!)n:evaluate", &form, &size, &PyTuple_Type, &rows, &count)
               ? evaluate_form(form, (size_t)size, rows, count)
               : NULL;
}
