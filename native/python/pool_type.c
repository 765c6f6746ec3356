/* The type Pool: making, closing, and the table of its methods. */

#include "python/python.h"

/* Closing */

static Entry enter_and_close(PyPool *self) {
    Entry entry;

    Py_BEGIN_ALLOW_THREADS entry = pool_enter(&self->pool);
    if (entry == ENTRY_ENTERED) {
        pool_close(&self->pool);
        pool_leave(&self->pool);
    }
    Py_END_ALLOW_THREADS return entry;
}

/* Returns false with an exception if reporting the last messages was interrupted, or if an FMU closes
 * its own pool. */
static bool close_pool(PyPool *self) {
    const Entry entry = enter_and_close(self);

    if (entry != ENTRY_ENTERED) {
        return entry == ENTRY_CLOSED || explain_entry(entry);
    }
    const bool reported = report_messages(self);
    log_close(&self->pool.log);
    return reported;
}

static PyObject *py_close(PyObject *object, PyObject *unused) {
    (void)unused;
    if (!close_pool((PyPool *)object)) {
        return NULL;
    }
    Py_RETURN_NONE;
}

/* An exception may already be set when this is called. This function cannot raise another one. */
static void close_at_the_end(PyPool *self) {
    PyObject *type, *value, *traceback;

    PyErr_Fetch(&type, &value, &traceback);
    if (!close_pool(self)) {
        PyErr_WriteUnraisable(NULL);
    }
    pool_dispose(&self->pool);
    PyErr_Restore(type, value, traceback);
}

static void pool_dealloc(PyObject *object) {
    PyPool *self = (PyPool *)object;
    PyTypeObject *type = Py_TYPE(object);
    freefunc release_memory = (freefunc)PyType_GetSlot(type, Py_tp_free);

    if (self->needs_closing) {
        close_at_the_end(self);
    }
    opening_drop(&self->opening);
    Py_XDECREF(self->playing);
    Py_XDECREF(self->arrays);
    Py_XDECREF(self->callback);
    release_memory(object);
    Py_DECREF(type);
}

/* Making */

/* The arrays that a pool is made with. */
typedef struct {
    PyArrayObject *inputs, *outputs, *statuses, *observations, *health;
} Arrays;

static bool require_arrays(const Settings *s, const Arrays *a) {
    const npy_intp n = (npy_intp)s->count;

    return require_matrix(a->inputs, "inputs", NPY_DOUBLE, NPY_ARRAY_CARRAY,
                          (npy_intp)s->inputs->count, n) &&
           require_matrix(a->outputs, "outputs", NPY_DOUBLE, NPY_ARRAY_CARRAY,
                          (npy_intp)s->outputs->count, n) &&
           require_vector(a->statuses, "statuses", NPY_INT8, NPY_ARRAY_CARRAY, n) &&
           require_matrix(a->observations, "observations", NPY_FLOAT, NPY_ARRAY_CARRAY, n,
                          (npy_intp)s->num_observed) &&
           require_matrix(a->health, "health", NPY_INT64, NPY_ARRAY_CARRAY, n, HEALTH_COUNTS);
}

static bool take_arrays(PyPool *self, PyObject *tuple) {
    Settings *s = &self->opening.settings;
    Arrays a;

    if (!PyArg_ParseTuple(tuple, "OOOOO;arrays", &a.inputs, &a.outputs, &a.statuses,
                          &a.observations, &a.health) ||
        !require_arrays(s, &a)) {
        return false;
    }
    self->arrays = Py_NewRef(tuple);
    self->inputs = matrix_of(a.inputs);
    self->observations = PyArray_DATA(a.observations);
    s->output_values = PyArray_DATA(a.outputs);
    s->status = PyArray_DATA(a.statuses);
    s->health = PyArray_DATA(a.health);
    return true;
}

static bool take_arguments(PyPool *self, PyObject *args) {
    const char *form;
    Py_ssize_t size;
    PyObject *arrays, *callback;

    if (!PyArg_ParseTuple(args, "y#O!O:Pool", &form, &size, &PyTuple_Type, &arrays, &callback) ||
        !require_no_fault("a pool", opening_take(&self->opening, form, (size_t)size)) ||
        !take_arrays(self, arrays)) {
        return false;
    }
    self->callback = Py_NewRef(callback);
    return true;
}

static bool open_pool(PyPool *self) {
    char error[8192];
    bool opened;

    self->needs_closing = true;
    Py_BEGIN_ALLOW_THREADS opened = pool_open(&self->pool, &self->opening.settings, error,
                                                sizeof error);
    Py_END_ALLOW_THREADS if (!report_messages(self)) {
        return false;
    }
    if (!opened) {
        PyObject *text = decode(error);
        PyErr_SetObject(PyExc_OSError, text);
        Py_XDECREF(text);
    }
    return opened;
}

static PyObject *pool_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) {
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyPool *self = (PyPool *)allocate(type, 0);

    (void)kwargs;
    if (self != NULL && take_arguments(self, args) && open_pool(self)) {
        return (PyObject *)self;
    }
    Py_XDECREF((PyObject *)self);
    return NULL;
}

static PyMethodDef methods[] = {
#define FAST(name, function) {name, (PyCFunction)(void (*)(void))function, METH_FASTCALL, NULL}
    {"step", py_step, METH_O, NULL},
    FAST("reset", py_reset),
    {"prepare_play", py_prepare_play, METH_VARARGS, NULL},
    FAST("play", py_play),
    {"check_actions", py_check_actions, METH_O, NULL},
    {"play_before", py_play_before, METH_O, NULL},
    {"play_after", py_play_after, METH_NOARGS, NULL},
    {"start", py_start, METH_O, NULL},
    {"count_steps", py_count_steps, METH_NOARGS, NULL},
    {"ask", py_ask, METH_VARARGS, NULL},
    {"close", py_close, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)pool_new},
    {Py_tp_dealloc, (void *)pool_dealloc},
    {Py_tp_methods, methods},
    {0, NULL},
};

PyType_Spec pool_spec = {"fmugym._native.Pool", sizeof(PyPool), 0, Py_TPFLAGS_DEFAULT, slots};
