/* The type Mark: a page of a file in which a crash leaves a mark. */

#include "python.h"

#include "crash.h"
#include "inside.h"

PyTypeObject *mark_type;

static PyObject *mark_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) {
    int file;

    (void)kwargs;
    if (!PyArg_ParseTuple(args, "i:Mark", &file)) {
        return NULL;
    }
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyMark *self = (PyMark *)allocate(type, 0);
    if (self != NULL && !mark_open(&self->mark, file)) {
        PyErr_SetFromErrno(PyExc_OSError);
        Py_CLEAR(self);
    }
    crash_watch();
    return (PyObject *)self;
}

static void mark_dealloc(PyObject *object) {
    PyTypeObject *type = Py_TYPE(object);
    freefunc release_memory = (freefunc)PyType_GetSlot(type, Py_tp_free);

    mark_close(&((PyMark *)object)->mark);
    release_memory(object);
    Py_DECREF(type);
}

static PyObject *py_begin(PyObject *object, PyObject *argument) {
    const long call = PyLong_AsLong(argument);

    if (call < 0 || call >= NUMBER_OF_CALLS) {
        if (!PyErr_Occurred()) {
            PyErr_SetString(PyExc_ValueError, "there is no such call");
        }
        return NULL;
    }
    begin_inside_python(&((PyMark *)object)->mark, (FmuCall)call);
    Py_RETURN_NONE;
}

static PyObject *py_end(PyObject *object, PyObject *unused) {
    (void)unused;
    end_inside_python();
    if (mark_struck) {
        mark_forgive(&((PyMark *)object)->mark);
    }
    Py_RETURN_NONE;
}

bool take_mark(PyObject *object, const Mark **mark) {
    if (object != Py_None && !PyObject_TypeCheck(object, mark_type)) {
        PyErr_SetString(PyExc_TypeError, "expected a Mark or None");
        return false;
    }
    *mark = object == Py_None ? NULL : &((PyMark *)object)->mark;
    return true;
}

static PyMethodDef methods[] = {
    {"begin", py_begin, METH_O, NULL},
    {"end", py_end, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)mark_new},
    {Py_tp_dealloc, (void *)mark_dealloc},
    {Py_tp_methods, methods},
    {0, NULL},
};

PyType_Spec mark_spec = {"fmugym._native.Mark", sizeof(PyMark), 0, Py_TPFLAGS_DEFAULT, slots};
