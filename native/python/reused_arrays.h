/* Arrays of numpy that are used again as soon as nobody else holds them. */

#ifndef FMUGYM_REUSED_ARRAYS_H
#define FMUGYM_REUSED_ARRAYS_H

#include "python/python.h"

enum {
    MOST_ARRAY_DIMENSIONS = 64, /* more than that numpy has none */
    KEPT_ARRAYS = 2             /* callers often hold the arrays of one step while they take the next */
};

typedef struct {
    PyObject *array;
    char *memory;
} Made;

/* Makes arrays of one shape and type. */
typedef struct {
    PyObject *type; /* NULL if nothing was taken over */
    size_t size;    /* in bytes */
    int dimensions;
    Py_ssize_t shape[MOST_ARRAY_DIMENSIONS], strides[MOST_ARRAY_DIMENSIONS];
    int flags; /* of a new array */
    Made made[KEPT_ARRAYS];
    unsigned oldest;
} Maker;

/* Imports numpy, before the first maker. Returns false with an exception if that is impossible. */
bool numpy_import(void);

/* Takes the arguments of numpy.empty, a tuple. Returns false with an exception if they do not fit.
 * The maker must be cleared before, and be dropped in any case. */
bool maker_take(Maker *maker, PyObject *arguments);
void maker_drop(Maker *maker);

/* Provides an array: a new one, or an earlier one that only the maker still holds. Returns NULL with
 * an exception if memory runs out. */
PyObject *maker_provide(Maker *maker, char **memory);
/* Fills the memory of an array with NaN, or with zeros if it holds no floats. */
void maker_blank(const Maker *maker, char *memory);

/* Returns the memory of an array that has the shape, type and strides of the maker's, and whose other
 * properties do not matter; otherwise NULL. */
const char *maker_memory_of(const Maker *maker, PyObject *object);

#endif
