/* Initial states that instances and processes share, as bytes. */

#include <stdlib.h>

#include "python.h"

typedef struct {
    size_t index;
    const Access *start;
    Packed packed; /* to be adopted */
    char *bytes;   /* newly packed */
    size_t size;
    bool done;
} Sharing;

static bool take_index(const PyPool *self, PyObject *number, Sharing *sharing) {
    const Py_ssize_t index = PyNumber_AsSsize_t(number, PyExc_IndexError);

    if (PyErr_Occurred()) {
        return false;
    }
    if (index < 0 || (size_t)index >= self->pool.settings.count) {
        PyErr_Format(PyExc_IndexError, "there is no instance %zd", index);
        return false;
    }
    sharing->index = (size_t)index;
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

static bool take_start(PyPool *self, PyObject *const *args, Sharing *sharing) {
    if (!take_index(self, args[0], sharing) || !is_access(self, args[1])) {
        return false;
    }
    sharing->start = &((PyAccess *)args[1])->access;
    return take_doubles(args[2], sharing->start->count, &sharing->packed.start_values);
}

static void do_look(PyPool *self, bool alone, void *context) {
    Sharing *s = context;
    (void)alone;
    s->done = pool_knows_start(&self->pool, s->index, s->start, s->packed.start_values);
}

PyObject *py_knows_start(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Sharing sharing = {0};

    if (!has_arguments(nargs, 3) || !take_start(self, args, &sharing) ||
        !perform(self, ALWAYS_SHORT, do_look, &sharing)) {
        return NULL;
    }
    return PyBool_FromLong(sharing.done);
}

static void do_pack(PyPool *self, bool alone, void *context) {
    Sharing *s = context;
    (void)alone;
    s->done = pool_pack(&self->pool, s->index, &s->bytes, &s->size);
}

PyObject *py_pack(PyObject *object, PyObject *index) {
    PyPool *self = (PyPool *)object;
    Sharing sharing = {0};
    PyObject *result;

    if (!take_index(self, index, &sharing) || !perform(self, NEVER_SHORT, do_pack, &sharing)) {
        return NULL;
    }
    if (sharing.done) {
        result = PyBytes_FromStringAndSize(sharing.bytes, (Py_ssize_t)sharing.size);
        free(sharing.bytes);
    } else {
        result = Py_NewRef(Py_None);
    }
    if (!report_messages(self)) {
        Py_CLEAR(result);
    }
    return result;
}

static void do_adopt(PyPool *self, bool alone, void *context) {
    Sharing *s = context;
    (void)alone;
    s->done = pool_adopt(&self->pool, s->index, s->start, &s->packed);
}

PyObject *py_adopt(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Sharing sharing = {0};
    char *bytes;
    Py_ssize_t size;

    if (!has_arguments(nargs, 5) || !take_start(self, args, &sharing) ||
        !take_doubles(args[3], self->pool.settings.outputs->count, &sharing.packed.outputs) ||
        PyBytes_AsStringAndSize(args[4], &bytes, &size) < 0) {
        return NULL;
    }
    sharing.packed.bytes = bytes;
    sharing.packed.size = (size_t)size;
    if (!perform(self, NEVER_SHORT, do_adopt, &sharing) || !report_messages(self)) {
        return NULL;
    }
    return PyBool_FromLong(sharing.done);
}
