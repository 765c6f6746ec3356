/* The type Guard: an environment is for one thread at a time. See fmugym/task/alone.py. */

#include "python.h"

PyTypeObject *guard_type;

/* How long a thread sleeps that waits for another one, in s. */
static const double NAP = 0.001;

/* The GIL guards the numbers. */
typedef struct {
    PyObject_HEAD unsigned long owner; /* the thread that is in a method */
    size_t depth;                      /* of how many methods, which have called each other */
} PyGuard;

static bool take(PyGuard *guard) {
    const unsigned long thread = PyThread_get_thread_ident();

    if (guard->depth > 0 && guard->owner != thread) {
        return false;
    }
    guard->owner = thread;
    guard->depth++;
    return true;
}

bool guard_take(PyObject *guard, const char *name) {
    const bool taken = take((PyGuard *)guard);

    if (!taken) {
        raise_simulation_error("%s is not possible while another thread is in a method of this "
                               "environment, which is for one thread at a time",
                               name);
    }
    return taken;
}

void guard_give_back(PyObject *guard) {
    ((PyGuard *)guard)->depth--;
}

static PyObject *guard_run(PyObject *object, PyObject *const *args, Py_ssize_t count) {
    const char *name = count < 2 ? NULL : PyUnicode_AsUTF8AndSize(args[0], NULL);

    if (name == NULL) {
        if (!PyErr_Occurred()) {
            PyErr_SetString(PyExc_TypeError, "run gets a name and a function");
        }
        return NULL;
    }
    PyObject *rest = PyTuple_New(count - 2), *result = NULL;
    for (Py_ssize_t i = 2; rest != NULL && i < count; i++) {
        PyTuple_SetItem(rest, i - 2, Py_NewRef(args[i]));
    }
    if (rest != NULL && guard_take(object, name)) {
        result = PyObject_Call(args[1], rest, NULL);
        guard_give_back(object);
    }
    Py_XDECREF(rest);
    return result;
}

static PyObject *guard_enter(PyObject *object, PyObject *unused) {
    (void)unused;
    while (!take((PyGuard *)object)) {
        PyObject *slept = PyObject_CallFunction(sleep_function, "d", NAP);
        if (slept == NULL || PyErr_CheckSignals() < 0) {
            Py_XDECREF(slept);
            return NULL;
        }
        Py_DECREF(slept);
    }
    Py_RETURN_NONE;
}

static PyObject *guard_exit(PyObject *object, PyObject *args) {
    (void)args;
    guard_give_back(object);
    Py_RETURN_NONE;
}

static void guard_dealloc(PyObject *object) {
    PyTypeObject *type = Py_TYPE(object);
    freefunc release_memory = (freefunc)PyType_GetSlot(type, Py_tp_free);

    release_memory(object);
    Py_DECREF(type);
}

static PyMethodDef methods[] = {
    {"run", (PyCFunction)(void (*)(void))guard_run, METH_FASTCALL, NULL},
    {"__enter__", guard_enter, METH_NOARGS, NULL},
    {"__exit__", guard_exit, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot slots[] = {
    {Py_tp_dealloc, (void *)guard_dealloc},
    {Py_tp_methods, methods},
    {0, NULL},
};

PyType_Spec guard_spec = {"fmugym._native.Guard", sizeof(PyGuard), 0, Py_TPFLAGS_DEFAULT, slots};
