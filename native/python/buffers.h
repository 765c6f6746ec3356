/* Arrays of the caller: of the right type, size, shape and alignment, or refused. */

#ifndef FMUGYM_BUFFERS_H
#define FMUGYM_BUFFERS_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stdbool.h>

typedef enum { ITEM_FLOAT64, ITEM_FLOAT32, ITEM_INT64, ITEM_INT8, ITEM_BOOLEAN } Item;

typedef enum {
    COPIED,   /* with any strides and at any address; values are copied out */
    IN_PLACE, /* C-contiguous and aligned, used in place */
    WRITTEN   /* likewise, and written */
} Use;

enum { ANY_LENGTH = -1 }; /* for a length of any number */

/* Takes an array; the shape has as many lengths as dimensions says. Returns false with an exception
 * that begins with the name if the array is another one. */
bool take_buffer(PyObject *object, Py_buffer *buffer, Use use, const char *name, Item item,
                 int dimensions, const Py_ssize_t *shape);

bool take_vector(PyObject *object, Py_buffer *buffer, Use use, const char *name, Item item,
                 Py_ssize_t length);
bool take_matrix(PyObject *object, Py_buffer *buffer, Use use, const char *name, Item item,
                 Py_ssize_t rows, Py_ssize_t columns);

/* Gives a buffer back, if there is one. */
void release_buffer(Py_buffer *buffer);

#endif
