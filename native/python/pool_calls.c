/* The methods of the type Pool that step, reset and read instances. */

#include <stdlib.h>
#include <string.h>

#include "derivatives.h"
#include "python.h"

/* A call and its result. */
typedef struct {
    int operation;
    Call call;
    size_t troubled;
} Doing;

/* The same with the arrays that it keeps. The pool's own arrays need no new buffer. */
typedef struct {
    Doing doing;
    Py_buffer inputs, mask, observations, values;
} PyCall;

static void release_views(PyCall *c) {
    release_buffer(&c->inputs);
    release_buffer(&c->mask);
    release_buffer(&c->observations);
    release_buffer(&c->values);
}

static Matrix matrix_of(const Py_buffer *buffer) {
    return (Matrix){buffer->buf, buffer->strides[0], buffer->strides[1]};
}

static bool view_inputs(PyPool *self, PyObject *object, PyCall *c) {
    const Settings *s = &self->pool.settings;
    Py_buffer *buffer = &self->buffers[INPUTS];

    if (object != self->arrays[INPUTS] && object != Py_None) {
        buffer = &c->inputs;
        if (!take_matrix(object, buffer, COPIED, "inputs", ITEM_FLOAT64,
                         (Py_ssize_t)s->inputs->count, (Py_ssize_t)s->count)) {
            return false;
        }
    }
    c->doing.call.inputs = matrix_of(buffer);
    return true;
}

static bool view_mask(PyPool *self, PyObject *object, PyCall *c) {
    if (object == Py_None) {
        return true;
    }
    if (!take_vector(object, &c->mask, COPIED, "the mask", ITEM_BOOLEAN,
                     (Py_ssize_t)self->pool.settings.count)) {
        return false;
    }
    c->doing.call.mask = (Mask){c->mask.buf, c->mask.strides[0]};
    return true;
}

static bool view_observations(PyPool *self, PyObject *object, PyCall *c) {
    const Settings *s = &self->pool.settings;
    Py_buffer *buffer = &self->buffers[OBSERVATIONS];

    if (object == Py_None) {
        return true;
    }
    if (object != self->arrays[OBSERVATIONS]) {
        buffer = &c->observations;
        if (!take_matrix(object, buffer, WRITTEN, "observations", ITEM_FLOAT32,
                         (Py_ssize_t)s->count, (Py_ssize_t)s->num_observed)) {
            return false;
        }
    }
    c->doing.call.observations = buffer->buf;
    return true;
}

static bool view_start(PyPool *self, PyObject *access, PyObject *values, PyCall *c) {
    if (!is_access(self, access)) {
        return false;
    }
    c->doing.call.start = &((PyAccess *)access)->access;
    if (!take_matrix(values, &c->values, COPIED, "values", ITEM_FLOAT64,
                     (Py_ssize_t)c->doing.call.start->count, (Py_ssize_t)self->pool.settings.count)) {
        return false;
    }
    c->doing.call.start_values = matrix_of(&c->values);
    return true;
}

static void do_call(PyPool *self, bool alone, void *context) {
    Doing *d = context;

    d->call.alone = alone;
    d->troubled = d->operation == STEP ? pool_step(&self->pool, &d->call)
                                       : pool_reset(&self->pool, &d->call);
}

static PyObject *result_of(PyPool *self, const Doing *d, bool done) {
    return done && report_messages(self) ? PyLong_FromSize_t(d->troubled) : NULL;
}

static PyObject *finish(PyPool *self, PyCall *c) {
    const bool done = perform(self, c->doing.operation, do_call, &c->doing);

    release_views(c);
    return result_of(self, &c->doing, done);
}

static PyObject *give_up(PyCall *c) {
    release_views(c);
    return NULL;
}

PyObject *py_step_own(PyObject *object, PyObject *unused) {
    PyPool *self = (PyPool *)object;
    Doing d = {.operation = STEP,
               .call = {.inputs = matrix_of(&self->buffers[INPUTS]),
                        .observations = self->buffers[OBSERVATIONS].buf}};

    (void)unused;
    return result_of(self, &d, perform(self, d.operation, do_call, &d));
}

PyObject *py_step(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    PyCall c = {.doing = {.operation = STEP}};

    if (has_arguments(nargs, 3) && view_inputs(self, args[0], &c) && view_mask(self, args[1], &c) &&
        view_observations(self, args[2], &c)) {
        return finish(self, &c);
    }
    return give_up(&c);
}

PyObject *py_reset(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    PyCall c = {.doing = {.operation = RESET}};

    if (has_arguments(nargs, 4) && view_inputs(self, Py_None, &c) &&
        view_start(self, args[0], args[1], &c) && view_mask(self, args[2], &c) &&
        view_observations(self, args[3], &c)) {
        return finish(self, &c);
    }
    return give_up(&c);
}

typedef struct {
    const Access *access;
    double *values;
    ptrdiff_t failed;
} Reading;

static void do_read(PyPool *self, bool alone, void *context) {
    Reading *r = context;
    (void)alone;
    r->failed = pool_read(&self->pool, r->access, r->values);
}

PyObject *py_read(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Py_buffer values;

    if (!has_arguments(nargs, 2) || !is_access(self, args[0])) {
        return NULL;
    }
    const Access *access = &((PyAccess *)args[0])->access;
    if (!take_matrix(args[1], &values, WRITTEN, "values", ITEM_FLOAT64, (Py_ssize_t)access->count,
                     (Py_ssize_t)self->pool.settings.count)) {
        return NULL;
    }
    Reading reading = {access, values.buf, -1};
    const bool done = perform(self, NEVER_SHORT, do_read, &reading);
    PyBuffer_Release(&values);
    return done && report_messages(self) ? PyLong_FromSsize_t(reading.failed) : NULL;
}

typedef struct {
    const Access *access;
    const double *values;
    ptrdiff_t failed;
} Writing;

static void do_write(PyPool *self, bool alone, void *context) {
    Writing *w = context;
    (void)alone;
    w->failed = pool_write(&self->pool, w->access, w->values);
}

PyObject *py_write(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Py_buffer values;

    if (!has_arguments(nargs, 2) || !is_access(self, args[0])) {
        return NULL;
    }
    const Access *access = &((PyAccess *)args[0])->access;
    if (!take_matrix(args[1], &values, IN_PLACE, "values", ITEM_FLOAT64,
                     (Py_ssize_t)access->count, (Py_ssize_t)self->pool.settings.count)) {
        return NULL;
    }
    Writing writing = {access, values.buf, -1};
    const bool done = perform(self, NEVER_SHORT, do_write, &writing);
    PyBuffer_Release(&values);
    return done && report_messages(self) ? PyLong_FromSsize_t(writing.failed) : NULL;
}

typedef struct {
    Question question;
    Matrix inputs;
    double *derivatives;
    ptrdiff_t failed;
} Asked;

static void do_differentiate(PyPool *self, bool alone, void *context) {
    Asked *a = context;
    (void)alone;
    a->failed = pool_differentiate(&self->pool, a->inputs, &a->question, a->derivatives);
}

/* The variables of a part have the functions of its FMU, so that is_access does not fit. */
static bool take_question(PyPool *self, PyObject *const *args, Question *question) {
    const System *system = self->pool.settings.system;
    const Py_ssize_t part = PyLong_AsSsize_t(args[1]);

    if (PyErr_Occurred()) {
        return false;
    }
    if (part < 0 || (size_t)part >= (system == NULL ? 1 : system->count)) {
        PyErr_Format(PyExc_ValueError, "there is no part %zd", part);
        return false;
    }
    if (!PyObject_TypeCheck(args[2], access_type) || !PyObject_TypeCheck(args[3], access_type)) {
        PyErr_SetString(PyExc_TypeError, "expected an Access");
        return false;
    }
    *question = (Question){.adjoint = args[0] == Py_True,
                           .part = (size_t)part,
                           .seeded = &((PyAccess *)args[2])->access,
                           .others = &((PyAccess *)args[3])->access};
    return true;
}

PyObject *py_differentiate(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Py_buffer derivatives;
    Asked asked = {.inputs = matrix_of(&self->buffers[INPUTS]), .failed = -1};

    if (!has_arguments(nargs, 5) || !take_question(self, args, &asked.question) ||
        !take_matrix(args[4], &derivatives, WRITTEN, "derivatives", ITEM_FLOAT64,
                     (Py_ssize_t)(asked.question.seeded->count * asked.question.others->count),
                     (Py_ssize_t)self->pool.settings.count)) {
        return NULL;
    }
    asked.derivatives = derivatives.buf;
    const bool done = perform(self, NEVER_SHORT, do_differentiate, &asked);
    PyBuffer_Release(&derivatives);
    return done && report_messages(self) ? PyLong_FromSsize_t(asked.failed) : NULL;
}

/* Queries */

typedef struct {
    size_t index;
    bool found;
    Failure failure;
} Asking;

static void do_ask(PyPool *self, bool alone, void *context) {
    Asking *a = context;
    (void)alone;
    a->found = pool_failure(&self->pool, a->index, &a->failure);
}

static PyObject *values_of(const Failure *f) {
    if (f->values == NULL) {
        Py_RETURN_NONE;
    }
    return PyBytes_FromStringAndSize((const char *)f->values,
                                     (Py_ssize_t)(f->number_of_values * sizeof *f->values));
}

PyObject *py_failure(PyObject *object, PyObject *argument) {
    PyPool *self = (PyPool *)object;
    const Py_ssize_t index = PyNumber_AsSsize_t(argument, PyExc_IndexError);

    if (PyErr_Occurred()) {
        return NULL;
    }
    if (index < 0 || (size_t)index >= self->pool.settings.count) {
        PyErr_Format(PyExc_IndexError, "there is no instance %zd", index);
        return NULL;
    }
    Asking asking = {.index = (size_t)index};
    if (!perform(self, ALWAYS_SHORT, do_ask, &asking)) {
        return NULL;
    }
    if (!asking.found) {
        Py_RETURN_NONE;
    }
    const Failure *f = &asking.failure;
    PyObject *result =
        Py_BuildValue("sOidINNz", f->doing, f->in_warm_up ? Py_True : Py_False, f->status, f->time,
                      (unsigned)f->reference, decode(f->said), values_of(f), f->part);
    free(f->said);
    free(f->values);
    return result;
}

static void do_count_steps(PyPool *self, bool alone, void *context) {
    (void)alone;
    (void)context;
    pool_count_steps(&self->pool);
}

PyObject *py_count_steps(PyObject *object, PyObject *unused) {
    (void)unused;
    if (!perform((PyPool *)object, NEVER_SHORT, do_count_steps, NULL)) {
        return NULL;
    }
    Py_RETURN_NONE;
}
