/* The methods of the type Pool for states as values: see states.h. */

#include <stdlib.h>
#include <string.h>

#include "../states.h"
#include "python.h"

static bool are_instances(const PyPool *self, const int64_t *indices, size_t count) {
    for (size_t i = 0; i < count; i++) {
        if (indices[i] < 0 || (size_t)indices[i] >= self->pool.settings.count) {
            PyErr_Format(PyExc_IndexError, "there is no instance %lld", (long long)indices[i]);
            return false;
        }
    }
    return true;
}

/* Copies a vector of integers, because its owner may change it at any time. */
static int64_t *copy_of(PyObject *object, const char *name, Py_ssize_t length, size_t *count) {
    Py_buffer buffer = {.obj = NULL};

    if (!take_vector(object, &buffer, IN_PLACE, name, ITEM_INT64, length)) {
        return NULL;
    }
    const size_t number = (size_t)buffer.shape[0];
    int64_t *copy = malloc((number + 1) * sizeof *copy);
    if (copy == NULL) {
        PyErr_NoMemory();
    } else {
        memcpy(copy, buffer.buf, number * sizeof *copy);
    }
    release_buffer(&buffer);
    *count = number;
    return copy;
}

/* Saving */

typedef struct {
    int64_t *indices, *ends;
    size_t count;
    bool records;
    Bytes all;
    ptrdiff_t failed;
} Saving;

static void do_save(PyPool *self, bool alone, void *context) {
    Saving *s = context;
    (void)alone;
    s->failed = pool_save_states(&self->pool, s->indices, s->count, s->records, &s->all, s->ends);
}

static bool take_saving(PyPool *self, PyObject *const *args, Saving *s) {
    s->records = args[1] == Py_True;
    s->indices = copy_of(args[0], "the indices", ANY_LENGTH, &s->count);
    s->ends = s->indices == NULL ? NULL : calloc(s->count + 1, sizeof *s->ends);
    if (s->indices != NULL && s->ends == NULL) {
        PyErr_NoMemory();
    }
    return s->ends != NULL && are_instances(self, s->indices, s->count);
}

static PyObject *list_of(const Saving *s) {
    PyObject *list = PyList_New((Py_ssize_t)s->count);
    int64_t begin = 0;

    for (size_t i = 0; list != NULL && i < s->count; i++) {
        PyObject *bytes = PyBytes_FromStringAndSize(s->all.bytes + begin, s->ends[i] - begin);
        if (bytes == NULL || PyList_SetItem(list, (Py_ssize_t)i, bytes) < 0) {
            Py_CLEAR(list);
        }
        begin = s->ends[i];
    }
    return list;
}

/* Takes indices, and whether to save records instead of states. Returns bytes for each instance, or
 * the index of the first one that fails. */
PyObject *py_save_states(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Saving s = {.indices = NULL};
    PyObject *result = NULL;

    if (has_arguments(nargs, 2) && take_saving(self, args, &s) &&
        perform(self, NEVER_SHORT, do_save, &s) && report_messages(self)) {
        result = s.failed >= 0 ? PyLong_FromSsize_t(s.failed) : list_of(&s);
    }
    free(s.indices);
    free(s.ends);
    free(s.all.bytes);
    return result;
}

/* Restoring */

typedef struct {
    PyObject *held; /* a tuple of the bytes */
    State *states;
    int64_t *indices;
    size_t count, troubled;
} Restoring;

static void do_restore(PyPool *self, bool alone, void *context) {
    Restoring *r = context;
    (void)alone;
    for (size_t i = 0; i < r->count; i++) {
        self->pool.chosen[i] = (uint32_t)r->indices[i];
    }
    r->troubled = pool_restore_states(&self->pool, r->states, r->count);
}

/* Each instance may be restored once in a call, so that no two threads work on it. */
static bool are_different(const PyPool *self, const Restoring *r) {
    const size_t count = self->pool.settings.count;
    char *seen = calloc(count, 1);
    bool different = seen != NULL && r->count <= count;

    for (size_t i = 0; different && i < r->count; i++) {
        different = !seen[r->indices[i]];
        seen[r->indices[i]] = 1;
    }
    free(seen);
    if (!different) {
        PyErr_SetString(PyExc_ValueError, "an instance is to be restored twice");
    }
    return different;
}

static bool take_states(const PyPool *self, Restoring *r) {
    r->states = calloc(r->count + 1, sizeof *r->states);
    if (r->states == NULL) {
        PyErr_NoMemory();
        return false;
    }
    for (size_t i = 0; i < r->count; i++) {
        char *bytes;
        Py_ssize_t size;
        if (PyBytes_AsStringAndSize(PyTuple_GetItem(r->held, (Py_ssize_t)i), &bytes, &size) < 0) {
            return false;
        }
        r->states[i] = (State){bytes, (size_t)size};
        if (!state_is_sound(&self->pool, r->states[i])) {
            PyErr_SetString(PyExc_ValueError, "a state is damaged, or not of this pool's FMU");
            return false;
        }
    }
    return true;
}

static bool take_restoring(PyPool *self, PyObject *const *args, Restoring *r) {
    r->held = PySequence_Tuple(args[0]);
    if (r->held == NULL) {
        return false;
    }
    size_t unused;
    r->count = (size_t)PyTuple_Size(r->held);
    r->indices = copy_of(args[1], "the indices", (Py_ssize_t)r->count, &unused);
    return r->indices != NULL && are_instances(self, r->indices, r->count) &&
           are_different(self, r) && take_states(self, r);
}

/* Takes a sequence of bytes and as many indices. Returns how many instances are in trouble. */
PyObject *py_restore_states(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Restoring r = {.held = NULL};
    PyObject *result = NULL;

    if (has_arguments(nargs, 2) && take_restoring(self, args, &r) &&
        perform(self, NEVER_SHORT, do_restore, &r) && report_messages(self)) {
        result = PyLong_FromSize_t(r.troubled);
    }
    Py_XDECREF(r.held);
    free(r.states);
    free(r.indices);
    return result;
}
