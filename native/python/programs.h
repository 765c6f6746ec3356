/* Programs as Python hands them over: see fmugym/vector/hooks/program.py. */

#ifndef FMUGYM_PROGRAMS_H
#define FMUGYM_PROGRAMS_H

#include "python.h"

enum { MOST_DIMENSIONS = 8 }; /* of an action */

/* A program, and its rows, which stay in use. */
typedef struct {
    ProgramForm form;
    Py_buffer *buffers;
    size_t number_of_buffers;
    Py_ssize_t seen_bytes[MOST_SEEN]; /* the size of each array of observations */
} PyProgram;

/* Takes a program for count instances: a tuple of its form and its rows, also a tuple. Returns false
 * with an exception if it is not sound; it must be released in any case. */
bool take_program(PyObject *parts, Py_ssize_t count, size_t action_elements, PyProgram *program);
void release_program(PyProgram *program);

/* Takes the arrays that a program stores observations in: a tuple, the values of a dict, or the only
 * one. There is room for MOST_SEEN. */
bool take_seen(const PyProgram *program, PyObject *arrays, Py_buffer *buffers, char **seen);

/* Takes a vector with any type of numbers. */
bool take_numbers(PyObject *object, Py_buffer *buffer, bool written, const char *name,
                  Py_ssize_t length);

/* Functions of the module */
PyObject *py_evaluate(PyObject *module, PyObject *args);
PyObject *py_serve(PyObject *module, PyObject *args);
PyObject *py_end_with(PyObject *module, PyObject *number);

#endif
