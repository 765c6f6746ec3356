/* The functions of the module that draw episodes: from random streams, or by a generator of numpy. */

#include "python/python.h"

PyObject *py_draw(PyObject *module, PyObject *args) {
    PyObject *form;
    PyArrayObject *streams, *values;
    unsigned long long normal, exponential;
    Draws draws;

    (void)module;
    if (!PyArg_ParseTuple(args, "(SKK)OO:draw", &form, &normal, &exponential, &streams, &values) ||
        !take_draws(form, normal, exponential, &draws) ||
        !require_matrix(streams, "streams", NPY_UINT64, NPY_ARRAY_CARRAY, ANY_LENGTH,
                        STREAM_NUMBERS) ||
        !require_matrix(values, "values", NPY_DOUBLE, NPY_ARRAY_CARRAY, (npy_intp)draws.count,
                        PyArray_DIM(streams, 0))) {
        return NULL;
    }
    const size_t count = (size_t)PyArray_DIM(streams, 0);
    for (size_t i = 0; i < count; i++) {
        BitGenerator bits = bits_of((Stream *)PyArray_DATA(streams) + i);
        draws_take(&draws, &bits, (double *)PyArray_DATA(values) + i, count);
    }
    Py_RETURN_NONE;
}

PyObject *py_draw_from(PyObject *module, PyObject *args) {
    PyObject *form, *capsule;
    PyArrayObject *starts, *values;
    unsigned long long normal, exponential;
    Draws draws;

    (void)module;
    if (!PyArg_ParseTuple(args, "(SKK)OOO:draw_from", &form, &normal, &exponential, &capsule,
                          &starts, &values) ||
        !take_draws(form, normal, exponential, &draws) ||
        !require_vector(starts, "start values", NPY_DOUBLE, NPY_ARRAY_CARRAY, ANY_LENGTH) ||
        !require_starts(&draws, PyArray_SIZE(starts)) ||
        !require_vector(values, "values", NPY_DOUBLE, NPY_ARRAY_CARRAY, (npy_intp)draws.count)) {
        return NULL;
    }
    BitGenerator *bits = PyCapsule_GetPointer(capsule, "BitGenerator");
    if (bits == NULL) {
        return NULL;
    }
    draws_take(&draws, bits, PyArray_DATA(values), 1);
    draws_start(&draws, PyArray_DATA(values), PyArray_DATA(starts), 1);
    Py_RETURN_NONE;
}
