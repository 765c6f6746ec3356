/* The type Access: a list of variables. */

#include "python/python.h"

PyTypeObject *access_type;

bool require_access(const PyPool *self, PyObject *object) {
    if (!PyObject_TypeCheck(object, access_type) ||
        ((PyAccess *)object)->access.fmi != self->pool.settings.fmi) {
        PyErr_SetString(PyExc_TypeError, "expected an Access of this FMI version");
        return false;
    }
    return true;
}

/* The memory of bytes is aligned. */
static const char *take_form(PyObject *form, Access *access) {
    const char *bytes = PyBytes_AsString(form);
    Reader reader = {bytes, bytes + PyBytes_Size(form), NULL};
    const Fmi *fmi = read_fmi(&reader);

    read_access(&reader, fmi, access);
    return reader.fault;
}

static PyObject *access_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) {
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyObject *form;

    (void)kwargs;
    if (!PyArg_ParseTuple(args, "S", &form)) {
        return NULL;
    }
    PyAccess *self = (PyAccess *)allocate(type, 0);
    const char *fault = self == NULL ? NULL : take_form(form, &self->access);
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
