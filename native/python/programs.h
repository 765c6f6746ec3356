/* Programs as Python hands them over: see fmugym/expressions/program.py. */

#ifndef FMUGYM_PROGRAMS_H
#define FMUGYM_PROGRAMS_H

#include "program/program_form.h"
#include "python/python.h"

/* Rows of programs, which stay in use. */
typedef struct {
    Py_buffer *buffers;
    Row *rows;
    size_t count;
} PyRows;

/* Takes a tuple of vectors of this length. Returns false with an exception if they are none; the rows
 * must be released in any case. */
bool take_rows(PyObject *tuple, Py_ssize_t length, PyRows *rows);
void release_rows(PyRows *rows);

/* A function of the module */
PyObject *py_evaluate(PyObject *module, PyObject *args);

#endif
