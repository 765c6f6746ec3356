/* The methods of the type Pool that step and reset instances, and ask for the rest. */

#include <stdlib.h>

#include "pool/requests.h"
#include "python/python.h"

/* A call, its result, and the arrays of the caller. All others are the pool's own. */
typedef struct {
    int operation;
    Call call;
    size_t troubled;
    Py_buffer mask, values;
} PyCall;

static Matrix matrix_of(const Py_buffer *buffer) {
    return (Matrix){buffer->buf, buffer->strides[0], buffer->strides[1]};
}

static bool take_mask(PyPool *self, PyObject *object, PyCall *c) {
    if (object == Py_None) {
        return true;
    }
    if (!take_vector(object, &c->mask, COPIED, "the mask", ITEM_BOOLEAN,
                     (Py_ssize_t)self->pool.settings.count)) {
        return false;
    }
    c->call.mask = (Mask){c->mask.buf, c->mask.strides[0]};
    return true;
}

static bool take_start(PyPool *self, PyObject *access, PyObject *values, PyCall *c) {
    if (!require_access(self, access)) {
        return false;
    }
    c->call.start = &((PyAccess *)access)->access;
    if (!take_matrix(values, &c->values, COPIED, "values", ITEM_FLOAT64,
                     (Py_ssize_t)c->call.start->count, (Py_ssize_t)self->pool.settings.count)) {
        return false;
    }
    c->call.start_values = matrix_of(&c->values);
    return true;
}

static void do_call(PyPool *self, bool alone, void *context) {
    PyCall *c = context;

    c->call.alone = alone;
    c->call.inputs = matrix_of(&self->buffers[INPUTS]);
    c->troubled = c->operation == STEP ? pool_step(&self->pool, &c->call)
                                       : pool_reset(&self->pool, &c->call);
}

static PyObject *make_call(PyPool *self, PyCall *c, bool good) {
    const bool done = good && perform(self, c->operation, do_call, c);

    release_buffer(&c->mask);
    release_buffer(&c->values);
    return done && report_messages(self) ? PyLong_FromSize_t(c->troubled) : NULL;
}

PyObject *py_step(PyObject *object, PyObject *mask) {
    PyPool *self = (PyPool *)object;
    PyCall c = {.operation = STEP, .call = {.observations = self->buffers[OBSERVATIONS].buf}};

    return make_call(self, &c, take_mask(self, mask, &c));
}

PyObject *py_reset(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    PyCall c = {.operation = RESET};

    return make_call(self, &c,
                  require_arguments(nargs, 3) && take_start(self, args[0], args[1], &c) &&
                      take_mask(self, args[2], &c));
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
    a->answer = pool_answer(&self->pool, matrix_of(&self->buffers[INPUTS]), a->request, &a->reader,
                            &a->writer);
}

static PyObject *answer_of(const Asking *a) {
    const Writer *writer = &a->writer;
    const char *bytes = writer->bytes == NULL ? "" : writer->bytes;

    return writer->failed ? PyErr_NoMemory()
                          : Py_BuildValue("iy#", (int)a->answer, bytes, (Py_ssize_t)writer->size);
}

/* Takes a request and its form. The memory of bytes is aligned. */
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
    const char *bytes = PyBytes_AsString(form);
    a.request = (Request)request;
    a.reader = (Reader){bytes, bytes + PyBytes_Size(form), NULL};
    PyObject *result =
        perform(self, NO_OPERATION, do_ask, &a) && report_messages(self) ? answer_of(&a) : NULL;
    free(a.writer.bytes);
    return result;
}
