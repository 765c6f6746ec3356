/* The type Access: a list of variables. */

#include "python.h"

PyTypeObject *access_type;

const Fmi *fmi_of(int version, int manner) {
    const Fmi *fmi = fmi_table(version, manner);

    if (fmi == NULL) {
        PyErr_Format(PyExc_ValueError, "there is no FMI %d", version);
    }
    return fmi;
}

bool is_access(const PyPool *self, PyObject *object) {
    if (!PyObject_TypeCheck(object, access_type) ||
        ((PyAccess *)object)->access.fmi != self->pool.settings.fmi) {
        PyErr_SetString(PyExc_TypeError, "expected an Access of this FMI version");
        return false;
    }
    return true;
}

static PyObject *access_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) {
    const char *types, *elements, *rest;
    Py_ssize_t count, size, size_of_rest;
    int version, manner = CO_SIMULATION_ALONE;
    Listing listing;

    (void)kwargs;
    if (!PyArg_ParseTuple(args, "iy#y#y#|i", &version, &types, &count, &elements, &size, &rest,
                          &size_of_rest, &manner)) {
        return NULL;
    }
    const Fmi *fmi = fmi_of(version, manner);
    if (fmi == NULL) {
        return NULL;
    }
    const char *fault = listing_take(&listing, types, (size_t)count, elements, (size_t)size, rest,
                                     (size_t)size_of_rest);
    if (fault != NULL) {
        PyErr_SetString(PyExc_ValueError, fault);
        return NULL;
    }
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyAccess *self = (PyAccess *)allocate(type, 0);
    if (self != NULL &&
        !access_open(&self->access, fmi, &listing)) {
        Py_DECREF(self);
        return PyErr_NoMemory();
    }
    return (PyObject *)self;
}

static void access_dealloc(PyObject *object) {
    PyTypeObject *type = Py_TYPE(object);
    freefunc release_memory = (freefunc)PyType_GetSlot(type, Py_tp_free);

    access_close(&((PyAccess *)object)->access);
    release_memory(object);
    Py_DECREF(type);
}

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)access_new},
    {Py_tp_dealloc, (void *)access_dealloc},
    {0, NULL},
};

PyType_Spec access_spec = {"fmugym._native.Access", sizeof(PyAccess), 0, Py_TPFLAGS_DEFAULT, slots};
