/* Arrays of the caller. An array of the wrong type, size, shape or alignment is refused. */

#ifndef FMUGYM_BUFFERS_H
#define FMUGYM_BUFFERS_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stdbool.h>

typedef enum {
    ITEM_FLOAT64,
    ITEM_FLOAT32,
    ITEM_INT64,
    ITEM_UINT64,
    ITEM_INT8,
    ITEM_BOOLEAN,
    ITEM_FLOAT16,
    ITEM_INT16,
    ITEM_INT32,
    ITEM_UINT8,
    ITEM_UINT16,
    ITEM_UINT32,
    ITEMS
} Item;

typedef enum {
    COPIED,   /* any strides and alignment; the values are copied */
    IN_PLACE, /* C-contiguous and aligned; the array is used in place */
    WRITTEN   /* like IN_PLACE, and the array is written to */
} Use;

enum { ANY_LENGTH = -1 }; /* stands for any length */

/* Take an array of one or two dimensions. If it does not fit, they return false with an exception
 * whose text begins with the name. */
bool take_vector(PyObject *object, Py_buffer *buffer, Use use, const char *name, Item item,
                 Py_ssize_t length);
bool take_matrix(PyObject *object, Py_buffer *buffer, Use use, const char *name, Item item,
                 Py_ssize_t rows, Py_ssize_t columns);

/* The type of the items of a buffer with a format, or ITEMS if it is another one. */
Item item_of(const Py_buffer *buffer);

/* Whether a buffer is such an array; otherwise sets an exception whose text begins with the name. The
 * shape has as many lengths as dimensions says. */
bool buffer_fits(const Py_buffer *buffer, Use use, const char *name, Item item, int dimensions,
                 const Py_ssize_t *shape);

/* Releases a buffer, if there is one. */
void release_buffer(Py_buffer *buffer);

#endif
