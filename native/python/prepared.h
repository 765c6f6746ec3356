/* What the steps of a single environment use: the result of prepare_single. See single.h. */

#ifndef FMUGYM_PREPARED_H
#define FMUGYM_PREPARED_H

#include "programs.h"
#include "single.h"

/* The name of the capsule that holds it. */
#define SINGLE "fmugym._native.single"

enum { NEXT, CURRENT, PREVIOUS, WANTED, KEPT, STEP_COUNT, SINGLE_BUFFERS };

/* An attribute of the environment that its programs depend on. */
typedef struct {
    PyObject *name, *value;
    PyObject *copy; /* equals the value as long as that has not changed in place; may be NULL */
    Py_buffer memory; /* of an array, of which the copy has the bytes */
} Watched;

/* The result of prepare_single. It never changes; the next call replaces it as a whole. */
typedef struct {
    Single single;
    PyProgram inputs, judgement;
    Py_buffer buffers[SINGLE_BUFFERS], seen_buffers[MOST_SEEN];
    char *seen[MOST_SEEN];
    Py_buffer *row_buffers; /* two for each row */
    size_t number_of_row_buffers;
    KeptRow *rows;
    Watched *watched;
    size_t number_of_watched;
    Register *memory;
    Registers input_registers, judgement_registers;
    PyObject *action_type; /* the class of actions, in addition to int */
    PyObject *copies, *names; /* make the observation: functions, and names or None */
    bool is_integer;
    long long lowest, highest;
    int dimensions;
    Py_ssize_t shape[MOST_DIMENSIONS + 1];
    char letter; /* the type of an array's elements */
} Prepared;

#endif
