/* Arrays of numpy, which are used again as soon as nobody else holds them. */

#include "python/reused_arrays.h"

#include <math.h>
#include <string.h>

/* What is built with the headers of numpy 2 also runs with numpy 1.26. */
#define NPY_TARGET_VERSION NPY_1_25_API_VERSION
#define NPY_NO_DEPRECATED_API NPY_1_25_API_VERSION
#include <numpy/arrayobject.h>

#if NPY_ABI_VERSION < 0x02000000
#error "the extension must be built with numpy 2 or newer"
#endif

bool numpy_import(void) {
    return PyArray_ImportNumPyAPI() >= 0;
}

/* Taking over */

static PyArrayObject *new_array(const Maker *maker) {
    Py_INCREF(maker->type); /* which the function takes */
    return (PyArrayObject *)PyArray_Empty(maker->dimensions, maker->shape,
                                          (PyArray_Descr *)maker->type, 0);
}

static bool take(Maker *maker, PyObject *type, int dimensions, const Py_ssize_t *shape) {
    maker->type = Py_NewRef(type);
    maker->dimensions = dimensions;
    memcpy(maker->shape, shape, (size_t)dimensions * sizeof *shape);
    PyArrayObject *array = new_array(maker);
    if (array == NULL) {
        return false;
    }
    maker->size = (size_t)PyArray_NBYTES(array);
    maker->flags = PyArray_FLAGS(array);
    memcpy(maker->strides, PyArray_STRIDES(array), (size_t)dimensions * sizeof *shape);
    Py_DECREF((PyObject *)array);
    return true;
}

bool maker_take(Maker *maker, PyObject *arguments) {
    Py_ssize_t shape[MOST_ARRAY_DIMENSIONS];
    PyArray_Descr *type;

    if (!PyTuple_Check(arguments) || PyTuple_Size(arguments) != 2) {
        PyErr_SetString(PyExc_TypeError, "expected a tuple of shape and type");
        return false;
    }
    const int dimensions =
        PyArray_IntpFromSequence(PyTuple_GetItem(arguments, 0), shape, MOST_ARRAY_DIMENSIONS);
    if (dimensions < 0 || !PyArray_DescrConverter(PyTuple_GetItem(arguments, 1), &type)) {
        return false;
    }
    const bool taken = take(maker, (PyObject *)type, dimensions, shape);
    Py_DECREF((PyObject *)type);
    return taken;
}

void maker_drop(Maker *maker) {
    for (size_t k = 0; k < KEPT_ARRAYS; k++) {
        Py_CLEAR(maker->made[k].array);
    }
    Py_CLEAR(maker->type);
}

/* Knowing arrays */

static bool has_form(const Maker *maker, const PyArrayObject *array) {
    const size_t lengths = (size_t)maker->dimensions * sizeof *maker->shape;

    return PyArray_NDIM(array) == maker->dimensions &&
           (PyObject *)PyArray_DESCR(array) == maker->type &&
           memcmp(PyArray_DIMS(array), maker->shape, lengths) == 0 &&
           memcmp(PyArray_STRIDES(array), maker->strides, lengths) == 0;
}

const char *maker_memory_of(const Maker *maker, PyObject *object) {
    PyArrayObject *array = (PyArrayObject *)object;

    return PyArray_CheckExact(object) && has_form(maker, array) ? PyArray_BYTES(array) : NULL;
}

static bool has_weak_references(PyObject *array) {
    return ((PyArrayObject_fields *)array)->weakreflist != NULL;
}

/* Whether nobody else holds an array, refers to it weakly, or has changed it in place. */
static bool is_free(const Maker *maker, const Made *made) {
    PyArrayObject *array = (PyArrayObject *)made->array;

    return array != NULL && Py_REFCNT(made->array) == 1 && !has_weak_references(made->array) &&
           PyArray_BYTES(array) == made->memory && PyArray_BASE(array) == NULL &&
           PyArray_FLAGS(array) == maker->flags && has_form(maker, array);
}

/* Providing */

static void fill(double *numbers, size_t count) {
    for (size_t i = 0; i < count; i++) {
        numbers[i] = NAN;
    }
}

static void fill32(float *numbers, size_t count) {
    for (size_t i = 0; i < count; i++) {
        numbers[i] = NAN;
    }
}

void maker_blank(const Maker *maker, char *memory) {
    const int type = ((const PyArray_Descr *)(const void *)maker->type)->type_num;

    if (type == NPY_DOUBLE) {
        fill((double *)(void *)memory, maker->size / sizeof(double));
    } else if (type == NPY_FLOAT) {
        fill32((float *)(void *)memory, maker->size / sizeof(float));
    } else {
        memset(memory, 0, maker->size);
    }
}

PyObject *maker_provide(Maker *maker, char **memory) {
    for (size_t k = 0; k < KEPT_ARRAYS; k++) {
        if (is_free(maker, &maker->made[k])) {
            *memory = maker->made[k].memory;
            return Py_NewRef(maker->made[k].array);
        }
    }
    PyArrayObject *array = new_array(maker);
    if (array == NULL) {
        return NULL;
    }
    *memory = PyArray_BYTES(array);
    Made *place = &maker->made[maker->oldest];
    PyObject *before = place->array;
    maker->oldest = (maker->oldest + 1) % KEPT_ARRAYS;
    *place = (Made){.array = Py_NewRef((PyObject *)array), .memory = *memory};
    Py_XDECREF(before); /* may call back, and another step then replaces the new array */
    return (PyObject *)array;
}
