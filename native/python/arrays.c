/* Arrays of numpy: checks of those of the caller, and making of those that calls return. */

#define IMPORTS_NUMPY
#include "python/arrays.h"

#include <math.h>
#include <string.h>

#if NPY_ABI_VERSION < 0x02000000
#error "the extension must be built with numpy 2 or newer"
#endif

/* Workers use the extension without numpy, so whoever takes the first array imports it. */
bool require_any_array(PyArrayObject *object, const char *name) {
    if (PyArray_ImportNumPyAPI() < 0) {
        return false;
    }
    if (!PyArray_Check((PyObject *)object)) {
        PyErr_Format(PyExc_TypeError, "%s must be an array of numpy", name);
        return false;
    }
    return true;
}

/* The arrays of the caller */

static bool has_shape(PyArrayObject *array, int dimensions, const npy_intp *shape) {
    if (PyArray_NDIM(array) != dimensions) {
        return false;
    }
    for (int i = 0; i < dimensions; i++) {
        if (shape[i] != ANY_LENGTH && PyArray_DIM(array, i) != shape[i]) {
            return false;
        }
    }
    return true;
}

static void refuse_type(PyArrayObject *array, const char *name, int type) {
    PyObject *expected = (PyObject *)PyArray_DescrFromType(type);

    PyErr_Format(PyExc_TypeError, "%s must be an array of %S, not of %S", name, expected,
                 (PyObject *)PyArray_DESCR(array));
    Py_XDECREF(expected);
}

static void refuse_shape(PyArrayObject *array, const char *name, int dimensions,
                         const npy_intp *shape) {
    PyObject *expected = PyArray_IntTupleFromIntp(dimensions, shape);
    PyObject *actual = PyArray_IntTupleFromIntp(PyArray_NDIM(array), PyArray_DIMS(array));

    if (expected != NULL && actual != NULL) {
        PyErr_Format(PyExc_ValueError, "%s must have the shape %S, not %S", name, expected, actual);
    }
    Py_XDECREF(expected);
    Py_XDECREF(actual);
}

bool require_array(PyArrayObject *array, const char *name, int type, int flags, int dimensions,
                   const npy_intp *shape) {
    if (!require_any_array(array, name)) {
        return false;
    }
    if (PyArray_TYPE(array) != type || !PyArray_ISNOTSWAPPED(array)) {
        refuse_type(array, name, type);
    } else if (!has_shape(array, dimensions, shape)) {
        refuse_shape(array, name, dimensions, shape);
    } else if (!PyArray_CHKFLAGS(array, flags)) {
        PyErr_Format(PyExc_ValueError, "%s must be C-contiguous, aligned and not read-only", name);
    } else {
        return true;
    }
    return false;
}

bool require_vector(PyArrayObject *array, const char *name, int type, int flags, npy_intp length) {
    return require_array(array, name, type, flags, 1, &length);
}

bool require_matrix(PyArrayObject *array, const char *name, int type, int flags, npy_intp rows,
                    npy_intp columns) {
    const npy_intp shape[] = {rows, columns};
    return require_array(array, name, type, flags, 2, shape);
}

/* Making arrays */

bool maker_take(Maker *maker, PyArrayObject *pattern) {
    if (!require_any_array(pattern, "a pattern of results")) {
        return false;
    }
    maker->pattern = (PyArrayObject *)Py_NewRef((PyObject *)pattern);
    maker->size = (size_t)PyArray_NBYTES(pattern);
    return true;
}

void maker_drop(Maker *maker) {
    for (size_t k = 0; k < KEPT_ARRAYS; k++) {
        Py_CLEAR(maker->made[k].array);
    }
    Py_CLEAR(maker->pattern);
}

static bool is_like(PyArrayObject *array, PyArrayObject *pattern) {
    const int dimensions = PyArray_NDIM(pattern);

    return PyArray_NDIM(array) == dimensions && PyArray_DESCR(array) == PyArray_DESCR(pattern) &&
           PyArray_CompareLists(PyArray_DIMS(array), PyArray_DIMS(pattern), dimensions) &&
           PyArray_CompareLists(PyArray_STRIDES(array), PyArray_STRIDES(pattern), dimensions);
}

const char *maker_memory_of(const Maker *maker, PyObject *object) {
    PyArrayObject *array = (PyArrayObject *)object;

    return PyArray_CheckExact(object) && is_like(array, maker->pattern) ? PyArray_BYTES(array)
                                                                        : NULL;
}

static bool has_weak_references(PyArrayObject *array) {
    return ((PyArrayObject_fields *)array)->weakreflist != NULL;
}

/* Whether nobody else holds an array, refers to it weakly, or has changed it in place. */
static bool is_free(const Made *made, PyArrayObject *pattern) {
    PyArrayObject *array = (PyArrayObject *)made->array;

    return array != NULL && Py_REFCNT(made->array) == 1 && !has_weak_references(array) &&
           PyArray_BYTES(array) == made->memory && PyArray_BASE(array) == NULL &&
           PyArray_FLAGS(array) == PyArray_FLAGS(pattern) && is_like(array, pattern);
}

PyObject *maker_provide(Maker *maker, char **memory) {
    for (size_t k = 0; k < KEPT_ARRAYS; k++) {
        if (is_free(&maker->made[k], maker->pattern)) {
            *memory = maker->made[k].memory;
            return Py_NewRef(maker->made[k].array);
        }
    }
    PyObject *array = PyArray_NewLikeArray(maker->pattern, NPY_CORDER, NULL, 0);
    if (array == NULL) {
        return NULL;
    }
    *memory = PyArray_BYTES((PyArrayObject *)array);
    Made *place = &maker->made[maker->oldest];
    PyObject *before = place->array;
    maker->oldest = (maker->oldest + 1) % KEPT_ARRAYS;
    *place = (Made){Py_NewRef(array), *memory};
    Py_XDECREF(before); /* may call back, and another step then replaces the new array */
    return array;
}

void maker_blank(const Maker *maker, char *memory) {
    const int type = PyArray_TYPE(maker->pattern);

    if (type == NPY_DOUBLE) {
        for (size_t i = 0; i < maker->size / sizeof(double); i++) {
            ((double *)(void *)memory)[i] = NAN;
        }
    } else if (type == NPY_FLOAT) {
        for (size_t i = 0; i < maker->size / sizeof(float); i++) {
            ((float *)(void *)memory)[i] = NAN;
        }
    } else {
        memset(memory, 0, maker->size);
    }
}
