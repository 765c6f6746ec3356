/* Forms of type bytes, whose memory is aligned. See forms/form.h. */

#include "python/python.h"

#include <stdlib.h>

bool require_no_fault(const char *form, const char *fault) {
    if (fault != NULL) {
        PyErr_Format(PyExc_ValueError, "the form of %s is damaged: %s", form, fault);
    }
    return fault == NULL;
}

Reader reader_of(PyObject *bytes) {
    const char *memory = PyBytes_AsString(bytes);

    return (Reader){memory, memory + PyBytes_Size(bytes), NULL};
}

/* A list of variables is kept in a capsule: a pool knows it again. */

static const char ACCESS[] = "fmugym._native.access";

static void free_access(PyObject *capsule) {
    Access *access = PyCapsule_GetPointer(capsule, ACCESS);

    access_close(access);
    free(access);
}

PyObject *py_access(PyObject *module, PyObject *form) {
    (void)module;
    if (!PyBytes_Check(form)) {
        PyErr_SetString(PyExc_TypeError, "a list of variables must be bytes");
        return NULL;
    }
    Access *access = calloc(1, sizeof *access);
    PyObject *capsule = access == NULL ? PyErr_NoMemory() : PyCapsule_New(access, ACCESS, free_access);
    if (capsule == NULL) {
        free(access);
        return NULL;
    }
    Reader reader = reader_of(form);
    const Fmi *fmi = read_fmi(&reader);
    read_access(&reader, fmi, access);
    if (!require_no_fault("a list of variables", reader.fault)) {
        Py_CLEAR(capsule);
    }
    return capsule;
}

const Access *require_access(const PyPool *self, PyObject *capsule) {
    const Access *access = PyCapsule_GetPointer(capsule, ACCESS);

    if (access != NULL && access->fmi != self->pool.settings.fmi) {
        PyErr_SetString(PyExc_ValueError, "the list of variables is of another FMI version");
        return NULL;
    }
    return access;
}

/* Draws */

bool take_draws(PyObject *form, unsigned long long standard_normal, unsigned long long exponential,
                Draws *draws) {
    Reader reader = reader_of(form);

    draws->standard_normal = (StandardNormal *)(uintptr_t)standard_normal;
    draws->exponential = (Exponential *)(uintptr_t)exponential;
    read_draws(&reader, draws);
    return require_no_fault("draws", reader.fault);
}

bool require_starts(const Draws *draws, npy_intp count) {
    return require_no_fault("draws",
                            draws_fit(draws, (size_t)count) ? NULL : "one is for no start value");
}
