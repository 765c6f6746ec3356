/* The methods of the type Pool that step and reset instances, and ask for the rest. */

#include <stdlib.h>

#include "pool/requests.h"
#include "python/python.h"

/* A call and its result. */
typedef struct {
    int operation;
    Call call;
    size_t troubled;
} PyCall;

static bool take_mask(PyPool *self, PyObject *object, PyCall *c) {
    PyArrayObject *mask = (PyArrayObject *)object;

    if (object == Py_None) {
        return true;
    }
    if (!require_vector(mask, "the mask", NPY_BOOL, 0, (npy_intp)self->pool.settings.count)) {
        return false;
    }
    c->call.mask = (Mask){PyArray_BYTES(mask), PyArray_STRIDE(mask, 0)};
    return true;
}

static bool take_start(PyPool *self, PyObject *capsule, PyObject *object, PyCall *c) {
    const Access *start = require_access(self, capsule);
    PyArrayObject *values = (PyArrayObject *)object;

    if (start == NULL || !require_matrix(values, "values", NPY_DOUBLE, 0, (npy_intp)start->count,
                                         (npy_intp)self->pool.settings.count)) {
        return false;
    }
    c->call.start = start;
    c->call.start_values = matrix_of(values);
    return true;
}

static void do_call(PyPool *self, bool alone, void *context) {
    PyCall *c = context;

    c->call.alone = alone;
    c->call.inputs = self->inputs;
    c->troubled = c->operation == STEP ? pool_step(&self->pool, &c->call)
                                       : pool_reset(&self->pool, &c->call);
}

static PyObject *make_call(PyPool *self, PyCall *c) {
    return perform(self, c->operation, do_call, c) && report_messages(self)
               ? PyLong_FromSize_t(c->troubled)
               : NULL;
}

PyObject *py_step(PyObject *object, PyObject *mask) {
    PyPool *self = (PyPool *)object;
    PyCall c = {.operation = STEP, .call = {.observations = self->observations}};

    return take_mask(self, mask, &c) ? make_call(self, &c) : NULL;
}

PyObject *py_reset(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    PyCall c = {.operation = RESET};

    return require_arguments(nargs, 3) && take_start(self, args[0], args[1], &c) &&
                   take_mask(self, args[2], &c)
               ? make_call(self, &c)
               : NULL;
}

static void do_count_steps(PyPool *self, bool alone, void *context) {
    (void)alone;
    (void)context;
    pool_count_steps(&self->pool);
}

PyObject *py_count_steps(PyObject *object, PyObject *unused) {
    (void)unused;
    return perform((PyPool *)object, NO_OPERATION, do_count_steps, NULL) ? Py_NewRef(Py_None) : NULL;
}

/* What is asked for besides steps and resets: see pool/requests.h. */

typedef struct {
    Request request;
    Reader reader;
    Writer writer;
    Answer answer;
} Asking;

static void do_ask(PyPool *self, bool alone, void *context) {
    Asking *a = context;

    (void)alone;
    a->answer = pool_answer(&self->pool, self->inputs, a->request, &a->reader,
                            &a->writer);
}

static PyObject *answer_of(const Asking *a) {
    const Writer *writer = &a->writer;
    const char *bytes = writer->bytes == NULL ? "" : writer->bytes;

    return writer->failed ? PyErr_NoMemory()
                          : Py_BuildValue("iy#", (int)a->answer, bytes, (Py_ssize_t)writer->size);
}

PyObject *py_ask(PyObject *object, PyObject *args) {
    PyPool *self = (PyPool *)object;
    Asking a = {.answer = ANSWER_ERROR};
    int request;
    PyObject *form;

    if (!PyArg_ParseTuple(args, "iS:ask", &request, &form)) {
        return NULL;
    }
    if (request < 0 || request >= REQUESTS) {
        PyErr_Format(PyExc_ValueError, "there is no request %d", request);
        return NULL;
    }
    a.request = (Request)request;
    a.reader = reader_of(form);
    PyObject *result =
        perform(self, NO_OPERATION, do_ask, &a) && report_messages(self) ? answer_of(&a) : NULL;
    free(a.writer.bytes);
    return result;
}
