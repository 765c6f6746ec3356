/* The type Access: a list of variables. */

#include <stdlib.h>
#include <string.h>

#include "python/python.h"

PyTypeObject *access_type;

bool is_access(const PyPool *self, PyObject *object) {
    if (!PyObject_TypeCheck(object, access_type) ||
        ((PyAccess *)object)->access.fmi != self->pool.settings.fmi) {
        PyErr_SetString(PyExc_TypeError, "expected an Access of this FMI version");
        return false;
    }
    return true;
}

/* The form may lie at any address. */
static const char *take_form(const char *form, Py_ssize_t size, Access *access) {
    char *copy = malloc((size_t)size + 1);

    if (copy == NULL) {
        return "out of memory";
    }
    memcpy(copy, form, (size_t)size);
    Reader reader = {copy, copy + size, NULL};
    const Fmi *fmi = read_fmi(&reader);
    read_access(&reader, fmi, access);
    free(copy);
    return reader.fault;
}

static PyObject *access_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) {
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    const char *form;
    Py_ssize_t size;

    (void)kwargs;
    if (!PyArg_ParseTuple(args, "y#", &form, &size)) {
        return NULL;
    }
    PyAccess *self = (PyAccess *)allocate(type, 0);
    const char *fault = self == NULL ? NULL : take_form(form, size, &self->access);
    if (fault != NULL) {
        Py_DECREF(self);
        PyErr_SetString(PyExc_ValueError, fault);
        return NULL;
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
