/* The arguments that a pool is made of: a form, and the arrays of the caller. */

#include "python/python.h"

static bool take_form(PyPool *self, const char *form, Py_ssize_t size) {
    const char *fault = opening_take(&self->opening, form, (size_t)size);

    if (fault != NULL) {
        PyErr_Format(PyExc_ValueError, "the form of a pool is damaged: %s", fault);
    }
    return fault == NULL;
}

static bool take_arrays(PyPool *self, PyObject *const *arrays) {
    const Settings *s = &self->opening.settings;
    Py_buffer *b = self->buffers;
    const Py_ssize_t n = (Py_ssize_t)s->count;

    return take_matrix(arrays[INPUTS], &b[INPUTS], WRITTEN, "inputs", ITEM_FLOAT64,
                       (Py_ssize_t)s->inputs->count, n) &&
           take_matrix(arrays[OUTPUTS], &b[OUTPUTS], WRITTEN, "outputs", ITEM_FLOAT64,
                       (Py_ssize_t)s->outputs->count, n) &&
           take_vector(arrays[STATUS], &b[STATUS], WRITTEN, "statuses", ITEM_INT8, n) &&
           take_matrix(arrays[OBSERVATIONS], &b[OBSERVATIONS], WRITTEN, "observations",
                       ITEM_FLOAT32, n, (Py_ssize_t)s->num_observed) &&
           take_matrix(arrays[HEALTH], &b[HEALTH], WRITTEN, "health", ITEM_INT64, n,
                       HEALTH_COUNTS);
}

bool take_pool_arguments(PyPool *self, PyObject *args) {
    PyObject *arrays[BUFFERS];
    Settings *s = &self->opening.settings;
    const char *form;
    Py_ssize_t size;

    if (!PyArg_ParseTuple(args, "y#(OOOOO)O:Pool", &form, &size, &arrays[INPUTS], &arrays[OUTPUTS],
                          &arrays[STATUS], &arrays[OBSERVATIONS], &arrays[HEALTH],
                          &self->callback) ||
        !take_form(self, form, size) || !take_arrays(self, arrays)) {
        self->callback = NULL;
        return false;
    }
    Py_INCREF(self->callback);
    s->output_values = self->buffers[OUTPUTS].buf;
    s->status = self->buffers[STATUS].buf;
    s->health = self->buffers[HEALTH].buf;
    return true;
}
