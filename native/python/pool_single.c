/* The methods of the type Pool for the steps of a single environment: see single.h. */

#include <stdlib.h>
#include <string.h>

#include "prepared.h"

/* Whether the environment still has all attributes that the programs were made of, and no others
 * than those that it had then. Returns -1 with an exception if a comparison fails. */
static int is_as_before(const Prepared *p, PyObject *attributes, Py_ssize_t size) {
    if (PyDict_Size(attributes) != size) {
        return 0;
    }
    for (size_t i = 0; i < p->number_of_watched; i++) {
        const Watched *w = &p->watched[i];
        if (PyDict_GetItemWithError(attributes, w->name) != w->value) {
            return PyErr_Occurred() ? -1 : 0;
        }
        if (w->memory.buf != NULL) {
            if (memcmp(w->memory.buf, PyBytes_AsString(w->copy), (size_t)w->memory.len) != 0) {
                return 0;
            }
        } else if (w->copy != Py_None) {
            const int same = PyObject_RichCompareBool(w->value, w->copy, Py_EQ);
            if (same != 1) {
                return same;
            }
        }
    }
    return 1;
}

/* Whether this is an integer of the range. Sets no exception. */
static bool take_integer(const Prepared *p, PyObject *action) {
    long long number = 0;

    if (PyLong_CheckExact(action)) {
        number = PyLong_AsLongLong(action);
    } else if ((PyObject *)Py_TYPE(action) == p->action_type) {
        PyObject *integer = PyNumber_Index(action);
        number = integer == NULL ? 0 : PyLong_AsLongLong(integer);
        Py_XDECREF(integer);
    } else {
        return false;
    }
    if (PyErr_Occurred()) {
        PyErr_Clear();
        return false;
    }
    *(int64_t *)(void *)p->single.next = number;
    return p->lowest <= number && number <= p->highest;
}

static bool fits(const Prepared *p, const Py_buffer *b) {
    bool same = b->ndim == p->dimensions && b->itemsize == (Py_ssize_t)p->single.size &&
                b->format != NULL && b->format[0] == p->letter && b->format[1] == '\0';

    for (int i = 0; same && i < b->ndim; i++) {
        same = b->shape[i] == p->shape[i];
    }
    return same;
}

static bool is_nan(char letter, const void *values, size_t i) {
    const double *doubles = values;
    const float *floats = values;

    switch (letter) {
    case 'd':
        return doubles[i] != doubles[i];
    case 'f':
        return floats[i] != floats[i];
    default:
        return false;
    }
}

static bool has_nan(const Prepared *p) {
    bool found = false;

    for (size_t i = 0; i < p->single.elements && !found; i++) {
        found = is_nan(p->letter, p->single.next, i);
    }
    return found;
}

/* Whether this is an array as the action space has it, without NaN. Sets no exception. */
static bool take_array(const Prepared *p, PyObject *action) {
    Py_buffer b;

    if ((PyObject *)Py_TYPE(action) != p->action_type) {
        return false;
    }
    if (PyObject_GetBuffer(action, &b, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        PyErr_Clear();
        return false;
    }
    const bool good = fits(p, &b);
    if (good) {
        memcpy(p->single.next, b.buf, (size_t)b.len);
    }
    PyBuffer_Release(&b);
    return good && !has_nan(p);
}

typedef struct {
    const Prepared *prepared;
    Call call;
    size_t troubled;
    SingleOutcome outcome;
    SingleResult result;
} Stepping;

static void do_single(PyPool *self, bool alone, void *context) {
    Stepping *s = context;

    s->call.alone = alone;
    s->outcome = single_step(&self->pool, &s->prepared->single, &s->call, &s->result);
}

static void do_before(PyPool *self, bool alone, void *context) {
    Stepping *s = context;

    (void)alone;
    s->outcome = single_before(&self->pool, &s->prepared->single) ? SINGLE_DONE : SINGLE_REFUSED;
}

static void do_after(PyPool *self, bool alone, void *context) {
    Stepping *s = context;

    (void)alone;
    s->outcome = single_after(&self->pool, &s->prepared->single, s->troubled, &s->result);
}

static PyObject *observation_of(const Prepared *p) {
    if (p->names == Py_None) {
        return PyObject_CallNoArgs(PyTuple_GetItem(p->copies, 0));
    }
    PyObject *observation = PyDict_New();
    for (Py_ssize_t i = 0; observation != NULL && i < PyTuple_Size(p->copies); i++) {
        PyObject *part = PyObject_CallNoArgs(PyTuple_GetItem(p->copies, i));
        if (part == NULL || PyDict_SetItem(observation, PyTuple_GetItem(p->names, i), part) < 0) {
            Py_CLEAR(observation);
        }
        Py_XDECREF(part);
    }
    return observation;
}

static PyObject *result_of(const Stepping *s) {
    PyObject *parts[] = {observation_of(s->prepared), PyFloat_FromDouble(s->result.reward),
                         PyBool_FromLong(s->result.terminated),
                         PyBool_FromLong(s->result.truncated), PyDict_New()};
    PyObject *result = PyTuple_New(5);
    bool good = result != NULL;

    for (int i = 0; i < 5; i++) {
        good = good && parts[i] != NULL;
    }
    for (int i = 0; i < 5; i++) {
        if (good) {
            PyTuple_SetItem(result, i, parts[i]); /* which takes over the reference */
        } else {
            Py_XDECREF(parts[i]);
        }
    }
    if (!good) {
        Py_CLEAR(result);
    }
    return result;
}

static void replace_reference(PyObject **place, PyObject *object) {
    PyObject *before = *place;

    *place = object;
    Py_XDECREF(before);
}

static void note_action(PyPool *self, PyObject *action) {
    replace_reference(&self->actions[1], self->actions[0]);
    self->actions[0] = Py_NewRef(action);
}

static PyObject *before_with(PyPool *self, const Prepared *p, PyObject *action) {
    Stepping s = {.prepared = p};

    if (!perform(self, ALWAYS_SHORT, do_before, &s)) {
        return NULL;
    }
    if (s.outcome == SINGLE_REFUSED) {
        Py_RETURN_NONE;
    }
    note_action(self, action);
    Py_RETURN_TRUE;
}

static PyObject *step_with(PyPool *self, const Prepared *p, PyObject *action) {
    const Py_buffer *inputs = &self->buffers[INPUTS];
    Stepping s = {.prepared = p,
                  .call = {.inputs = {inputs->buf, inputs->strides[0], inputs->strides[1]},
                           .observations = self->buffers[OBSERVATIONS].buf}};

    if (!perform(self, STEP, do_single, &s)) {
        return NULL;
    }
    if (s.outcome == SINGLE_REFUSED) {
        Py_RETURN_NONE;
    }
    note_action(self, action);
    if (!report_messages(self)) {
        return NULL;
    }
    return s.outcome == SINGLE_TROUBLED ? PyBool_FromLong(0) : result_of(&s);
}

typedef PyObject *WithAction(PyPool *self, const Prepared *prepared, PyObject *action);

/* Takes an action, the attributes of the environment, and how many there must be. Returns None
 * without any further work if they are not as they were prepared. */
static PyObject *do_with(PyPool *self, WithAction *work, PyObject *const *args, Py_ssize_t nargs) {
    if (!has_arguments(nargs, 3)) {
        return NULL;
    }
    if (self->single == NULL || !PyDict_Check(args[1])) {
        PyErr_SetString(PyExc_TypeError, "step_single was not prepared, or gets no dict");
        return NULL;
    }
    PyObject *capsule = Py_NewRef(self->single);
    const Prepared *p = PyCapsule_GetPointer(capsule, SINGLE);
    const Py_ssize_t size = PyLong_AsSsize_t(args[2]);
    const int same = PyErr_Occurred() ? -1 : is_as_before(p, args[1], size);
    PyObject *result = NULL;
    if (same == 1 && (p->is_integer ? take_integer(p, args[0]) : take_array(p, args[0]))) {
        result = work(self, p, args[0]);
    } else if (same >= 0) {
        result = Py_NewRef(Py_None);
    }
    Py_DECREF(capsule);
    return result;
}

PyObject *py_step_single(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    return do_with((PyPool *)object, step_with, args, nargs);
}

PyObject *py_before_single(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    return do_with((PyPool *)object, before_with, args, nargs);
}

/* Takes how many instances had trouble in the step. */
PyObject *py_after_single(PyObject *object, PyObject *troubled) {
    PyPool *self = (PyPool *)object;
    Stepping s = {.troubled = PyLong_AsSize_t(troubled)};

    if (PyErr_Occurred()) {
        return NULL;
    }
    if (self->single == NULL) {
        PyErr_SetString(PyExc_TypeError, "step_single was not prepared");
        return NULL;
    }
    PyObject *capsule = Py_NewRef(self->single), *result = NULL;
    s.prepared = PyCapsule_GetPointer(capsule, SINGLE);
    if (perform(self, ALWAYS_SHORT, do_after, &s)) {
        result = s.outcome == SINGLE_TROUBLED ? PyBool_FromLong(0) : result_of(&s);
    }
    Py_DECREF(capsule);
    return result;
}

/* Takes what counts as the action of the step before. */
PyObject *py_begin_single(PyObject *object, PyObject *action) {
    PyPool *self = (PyPool *)object;

    replace_reference(&self->actions[1], Py_NewRef(action));
    replace_reference(&self->actions[0], Py_NewRef(action));
    Py_RETURN_NONE;
}

PyObject *py_actions_of_single(PyObject *object, PyObject *unused) {
    const PyPool *self = (PyPool *)object;

    (void)unused;
    if (self->actions[0] == NULL) {
        Py_RETURN_NONE;
    }
    return PyTuple_Pack(2, self->actions[0], self->actions[1]);
}
