/* Arrays of numpy: those of the caller, and those that calls return. */

#ifndef FMUGYM_ARRAYS_H
#define FMUGYM_ARRAYS_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

/* What is built with the headers of numpy 2 also runs with numpy 1.26. */
#define NPY_TARGET_VERSION NPY_1_25_API_VERSION
#define NPY_NO_DEPRECATED_API NPY_1_25_API_VERSION
#define PY_ARRAY_UNIQUE_SYMBOL fmugym_numpy
#ifndef IMPORTS_NUMPY /* only arrays.c does */
#define NO_IMPORT_ARRAY
#endif
#include <numpy/arrayobject.h>

#include <stdbool.h>

/* The arrays of the caller */

enum { ANY_LENGTH = -1 }; /* stands for any length */

/* All four return whether an object is such an array; if not, they set an exception whose text begins
 * with the name. The shape has as many lengths as dimensions says; flags are those of numpy, such as
 * NPY_ARRAY_CARRAY. */
bool require_any_array(PyArrayObject *object, const char *name);
bool require_array(PyArrayObject *object, const char *name, int type, int flags, int dimensions,
                   const npy_intp *shape);
bool require_vector(PyArrayObject *object, const char *name, int type, int flags, npy_intp length);
bool require_matrix(PyArrayObject *object, const char *name, int type, int flags, npy_intp rows,
                    npy_intp columns);

/* The arrays that calls return are used again as soon as nobody else holds them. */

enum { KEPT_ARRAYS = 2 /* callers often hold the arrays of one step while they take the next */ };

typedef struct {
    PyObject *array;
    char *memory;
} Made;

/* Makes arrays like a pattern. */
typedef struct {
    PyArrayObject *pattern; /* NULL if nothing was taken over */
    size_t size;            /* in bytes */
    Made made[KEPT_ARRAYS];
    unsigned oldest;
} Maker;

/* Takes an array as the pattern. Returns false with an exception if it is none. The maker must be
 * cleared before, and be dropped in any case. */
bool maker_take(Maker *maker, PyArrayObject *pattern);
void maker_drop(Maker *maker);

/* Provides an array: a new one, or an earlier one that only the maker still holds. Returns NULL with
 * an exception if memory runs out. */
PyObject *maker_provide(Maker *maker, char **memory);
/* Fills the memory of an array with NaN, or with zeros if it holds no floats. */
void maker_blank(const Maker *maker, char *memory);

/* Returns the memory of an array that has the shape, type and strides of the pattern, and whose other
 * properties do not matter; otherwise NULL. */
const char *maker_memory_of(const Maker *maker, PyObject *object);

#endif
