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
    const char *bytes[4];
    Py_ssize_t sizes[4];
    Block blocks[4];
    int version, manner = CO_SIMULATION_ALONE;
    Listing listing;

    (void)kwargs;
    if (!PyArg_ParseTuple(args, "iy#y#y#y#|i", &version, &bytes[0], &sizes[0], &bytes[1],
                          &sizes[1], &bytes[2], &sizes[2], &bytes[3], &sizes[3], &manner)) {
        return NULL;
    }
    for (int i = 0; i < 4; i++) {
        blocks[i] = (Block){bytes[i], (size_t)sizes[i]};
    }
    const Fmi *fmi = fmi_of(version, manner);
    if (fmi == NULL) {
        return NULL;
    }
    const char *fault = listing_take(&listing, blocks[0], blocks[1], blocks[2], blocks[3]);
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
