/* Whether a reset would restore the state after the last initialization. */

#include "python.h"

typedef struct {
    size_t index;
    const Access *start;
    const double *start_values;
    bool done;
} Look;

static bool take_index(const PyPool *self, PyObject *number, Look *look) {
    const Py_ssize_t index = PyNumber_AsSsize_t(number, PyExc_IndexError);

    if (PyErr_Occurred()) {
        return false;
    }
    if (index < 0 || (size_t)index >= self->pool.settings.count) {
        PyErr_Format(PyExc_IndexError, "there is no instance %zd", index);
        return false;
    }
    look->index = (size_t)index;
    return true;
}

/* Takes one float64 for each of count variables from bytes. */
static bool take_doubles(PyObject *bytes, size_t count, const double **values) {
    char *data;
    Py_ssize_t size;

    if (PyBytes_AsStringAndSize(bytes, &data, &size) < 0) {
        return false;
    }
    if ((size_t)size != count * sizeof **values) {
        PyErr_Format(PyExc_ValueError, "%zu float64 are wanted, not %zd bytes", count, size);
        return false;
    }
    *values = (const double *)(const void *)data; /* the data of bytes are aligned to 8 bytes */
    return true;
}

static bool take_start(PyPool *self, PyObject *const *args, Look *look) {
    if (!take_index(self, args[0], look) || !is_access(self, args[1])) {
        return false;
    }
    look->start = &((PyAccess *)args[1])->access;
    return take_doubles(args[2], look->start->count, &look->start_values);
}

static void do_look(PyPool *self, bool alone, void *context) {
    Look *s = context;
    (void)alone;
    s->done = pool_knows_start(&self->pool, s->index, s->start, s->start_values);
}

PyObject *py_knows_start(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Look look = {0};

    if (!has_arguments(nargs, 3) || !take_start(self, args, &look) ||
        !perform(self, ALWAYS_SHORT, do_look, &look)) {
        return NULL;
    }
    return PyBool_FromLong(look.done);
}
