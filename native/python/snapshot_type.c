/* The type Snapshot: FMU states that are freed with the last reference. Also the pool's methods
 * for it. */

#include <stdlib.h>

#include "handlers.h"

PyTypeObject *snapshot_type;

static void abandon(PyPool *pool, Snapshot *snapshot) {
    Held held = {.count = 0};
    PyObject *type, *value, *traceback;

    PyErr_Fetch(&type, &value, &traceback);
    if (pool->calls_python) {
        handlers_hold_at_the_end(&held);
    }
    pool_abandon(&pool->pool, snapshot);
    handlers_postpone(&held);
    PyErr_Restore(type, value, traceback);
}

/* May run on any thread and at any time, even during a call of the pool. */
static void snapshot_dealloc(PyObject *object) {
    PySnapshot *self = (PySnapshot *)object;
    PyTypeObject *type = Py_TYPE(object);
    freefunc release_memory = (freefunc)PyType_GetSlot(type, Py_tp_free);

    if (self->snapshot != NULL) {
        abandon((PyPool *)self->pool, self->snapshot);
    }
    Py_XDECREF(self->pool);
    release_memory(object);
    Py_DECREF(type);
}

static PyType_Slot slots[] = {
    {Py_tp_dealloc, (void *)snapshot_dealloc},
    {0, NULL},
};

PyType_Spec snapshot_spec = {"fmugym._native.Snapshot", sizeof(PySnapshot), 0,
                             Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, slots};

typedef struct {
    Snapshot *snapshot;
    ptrdiff_t failed;
} Saving;

static void do_save(PyPool *self, bool alone, void *context) {
    Saving *saving = context;
    (void)alone;
    saving->failed = pool_save(&self->pool, saving->snapshot);
}

static PyObject *wrap(PyPool *self, Snapshot *snapshot) {
    allocfunc allocate = (allocfunc)PyType_GetSlot(snapshot_type, Py_tp_alloc);
    PySnapshot *made = (PySnapshot *)allocate(snapshot_type, 0);

    if (made == NULL) {
        pool_abandon(&self->pool, snapshot);
        return NULL;
    }
    made->pool = Py_NewRef((PyObject *)self);
    made->snapshot = snapshot;
    return (PyObject *)made;
}

PyObject *py_save(PyObject *object, PyObject *unused) {
    PyPool *self = (PyPool *)object;
    Saving saving = {snapshot_new(self->pool.settings.count), -1};

    (void)unused;
    if (saving.snapshot == NULL) {
        return PyErr_NoMemory();
    }
    if (!perform(self, NEVER_SHORT, do_save, &saving)) {
        free(saving.snapshot);
        return NULL;
    }
    PyObject *result =
        saving.failed >= 0 ? PyLong_FromSsize_t(saving.failed) : wrap(self, saving.snapshot);
    if (result != NULL && !report_messages(self)) {
        Py_DECREF(result);
        return NULL;
    }
    return result;
}

typedef struct {
    const Snapshot *snapshot;
    Mask mask;
    bool own;
    size_t troubled;
} Restoring;

static void do_restore(PyPool *self, bool alone, void *context) {
    Restoring *r = context;
    (void)alone;
    r->own = pool_restore(&self->pool, r->snapshot, r->mask, &r->troubled);
}

static bool is_snapshot_of(const PyPool *self, PyObject *object) {
    if (!PyObject_TypeCheck(object, snapshot_type) ||
        ((PySnapshot *)object)->pool != (const PyObject *)self) {
        PyErr_SetString(PyExc_ValueError, "the snapshot was taken from another pool");
        return false;
    }
    return true;
}

static PyObject *restore(PyPool *self, Restoring *restoring) {
    if (!perform(self, NEVER_SHORT, do_restore, restoring)) {
        return NULL;
    }
    if (!restoring->own) {
        PyErr_SetString(PyExc_ValueError, "the snapshot is of another instance than this one");
        return NULL;
    }
    return report_messages(self) ? PyLong_FromSize_t(restoring->troubled) : NULL;
}

PyObject *py_restore(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Py_buffer mask = {.obj = NULL};
    Restoring restoring = {.own = false};

    if (!has_arguments(nargs, 2) || !is_snapshot_of(self, args[0])) {
        return NULL;
    }
    if (args[1] != Py_None) {
        if (!take_vector(args[1], &mask, COPIED, "the mask", ITEM_BOOLEAN,
                         (Py_ssize_t)self->pool.settings.count)) {
            return NULL;
        }
        restoring.mask = (Mask){mask.buf, mask.strides[0]};
    }
    restoring.snapshot = ((PySnapshot *)args[0])->snapshot;
    PyObject *result = restore(self, &restoring);
    release_buffer(&mask);
    return result;
}
