/* The type Draws: the distributions of an episode. */

#include "program/program_form.h"
#include "python/python.h"

PyTypeObject *draws_type;

/* The memory of bytes is aligned. */
static bool take_form(PyDraws *self, PyObject *form) {
    const char *bytes = PyBytes_AsString(form);
    Reader reader = {bytes, bytes + PyBytes_Size(form), NULL};

    self->form = Py_NewRef(form);
    if (!read_draws(&reader, &self->draws)) {
        PyErr_SetString(PyExc_ValueError, reader.fault);
    }
    return reader.fault == NULL;
}

static PyObject *draws_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) {
    PyObject *form;
    unsigned long long normal, exponential = 0;

    (void)kwargs;
    if (!PyArg_ParseTuple(args, "SK|K", &form, &normal, &exponential)) {
        return NULL;
    }
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyDraws *self = (PyDraws *)allocate(type, 0);
    if (self == NULL) {
        return NULL;
    }
    self->draws.standard_normal = (StandardNormal *)(uintptr_t)normal;
    self->draws.exponential = (Exponential *)(uintptr_t)exponential;
    if (!take_form(self, form)) {
        Py_DECREF(self);
        return NULL;
    }
    return (PyObject *)self;
}

static void draws_dealloc(PyObject *object) {
    PyTypeObject *type = Py_TYPE(object);
    freefunc release_memory = (freefunc)PyType_GetSlot(type, Py_tp_free);

    Py_XDECREF(((PyDraws *)object)->form);
    release_memory(object);
    Py_DECREF(type);
}

static void take_each(const Draws *draws, const Py_buffer *states, const Py_buffer *values) {
    const Py_ssize_t count = states->shape[0];

    for (Py_ssize_t i = 0; i < count; i++) {
        BitGenerator bits = bits_of((Stream *)states->buf + i);
        draws_take(draws, &bits, (double *)values->buf + i, (size_t)count);
    }
}

static PyObject *draws_take_all(PyObject *object, PyObject *args) {
    const Draws *draws = &((PyDraws *)object)->draws;
    PyObject *streams, *array;
    Py_buffer states = {0}, values = {0};

    if (!PyArg_ParseTuple(args, "OO:take", &streams, &array)) {
        return NULL;
    }
    const bool good = take_matrix(streams, &states, WRITTEN, "states", ITEM_UINT64, ANY_LENGTH,
                                  STREAM_NUMBERS) &&
                      take_matrix(array, &values, WRITTEN, "values", ITEM_FLOAT64,
                                  (Py_ssize_t)draws->count, states.shape[0]);
    if (good) {
        take_each(draws, &states, &values);
    }
    release_buffer(&values);
    release_buffer(&states);
    return good ? Py_NewRef(Py_None) : NULL;
}

static PyObject *list_of(const double *values, size_t count) {
    PyObject *list = PyList_New((Py_ssize_t)count);

    for (size_t i = 0; i < count && list != NULL; i++) {
        PyList_SetItem(list, (Py_ssize_t)i, PyFloat_FromDouble(values[i]));
    }
    return list;
}

static PyObject *take_from(const Draws *draws, BitGenerator *bits, const Py_buffer *starts) {
    double *values = PyMem_Malloc(draws->count * sizeof *values + 1);

    if (values == NULL) {
        return PyErr_NoMemory();
    }
    draws_take(draws, bits, values, 1);
    draws_start(draws, values, starts->buf, 1);
    PyObject *list = list_of(values, draws->count);
    PyMem_Free(values);
    return list;
}

static PyObject *draws_take_from(PyObject *object, PyObject *args) {
    const Draws *draws = &((PyDraws *)object)->draws;
    PyObject *capsule, *array, *result = NULL;
    Py_buffer starts = {0};

    if (!PyArg_ParseTuple(args, "OO:take_from", &capsule, &array)) {
        return NULL;
    }
    BitGenerator *bits = PyCapsule_GetPointer(capsule, "BitGenerator");
    if (bits != NULL && take_vector(array, &starts, WRITTEN, "start_values", ITEM_FLOAT64,
                                    ANY_LENGTH)) {
        if (draws_fit(draws, (size_t)starts.shape[0])) {
            result = take_from(draws, bits, &starts);
        } else {
            PyErr_SetString(PyExc_ValueError, "start_values has too few rows");
        }
    }
    release_buffer(&starts);
    return result;
}

static PyMethodDef methods[] = {
    {"take", draws_take_all, METH_VARARGS, NULL},
    {"take_from", draws_take_from, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)draws_new},
    {Py_tp_dealloc, (void *)draws_dealloc},
    {Py_tp_methods, methods},
    {0, NULL},
};

PyType_Spec draws_spec = {"fmugym._native.Draws", sizeof(PyDraws), 0, Py_TPFLAGS_DEFAULT, slots};
