/* The step of a single environment: a batch of one, with the result that Gymnasium's step has. */

#include "playing.h"

#include <stdint.h>
#include <stdlib.h>

static const char *const ONE = "fmugym._native.one";

/* An attribute that the programs were made of. */
typedef struct {
    PyObject *name;
    const void *value; /* the address of the object; NULL if there must not be the attribute */
} Watched;

/* The result of prepare_one. The turn is used inside of the pool only. */
typedef struct {
    PyObject *playing; /* the capsule that prepare_play has made */
    PyObject *names, *observe, *inform, *judge, *complete, *guard;
    Watched *watched; /* their names are those of the tuple */
    size_t number_of_watched;
    double *inputs; /* memory for those of the pool */
    PyTurn turn;
} One;

static void one_free(One *one) {
    if (one->playing != NULL) {
        release_turn(playing_of(one->playing), &one->turn);
    }
    Py_XDECREF(one->playing);
    Py_XDECREF(one->names);
    Py_XDECREF(one->observe);
    Py_XDECREF(one->inform);
    Py_XDECREF(one->judge);
    Py_XDECREF(one->complete);
    Py_XDECREF(one->guard);
    free(one->watched);
    free(one->inputs);
    free(one);
}

static void one_dealloc(PyObject *capsule) {
    one_free(PyCapsule_GetPointer(capsule, ONE));
}

static bool take_watched(One *one) {
    one->watched = calloc((size_t)PyTuple_Size(one->names) + 1, sizeof *one->watched);
    if (one->watched == NULL) {
        PyErr_NoMemory();
        return false;
    }
    for (Py_ssize_t i = 0; i < PyTuple_Size(one->names); i++) {
        Watched *w = &one->watched[one->number_of_watched++];
        PyObject *address = NULL;
        if (!PyArg_ParseTuple(PyTuple_GetItem(one->names, i), "O|O;a name and an address", &w->name,
                              &address)) {
            return false;
        }
        w->value = address == NULL ? NULL : PyLong_AsVoidPtr(address);
    }
    return !PyErr_Occurred();
}

static bool fill(PyPool *self, One *one, PyObject *args) {
    const Playing *playing = playing_of(one->playing);
    Py_buffer *b = one->turn.buffers;
    PyObject *seen, *rewards, *terminated, *truncated;

    if (!PyArg_ParseTuple(args, "OOOOO!OOOOO!:prepare_one", &seen, &rewards, &terminated,
                          &truncated, &PyTuple_Type, &one->names, &one->observe, &one->inform,
                          &one->judge, &one->complete, guard_type, &one->guard)) {
        one->names = one->observe = one->inform = NULL; /* not ours yet */
        one->judge = one->complete = one->guard = NULL;
        return false;
    }
    Py_INCREF(one->names);
    Py_INCREF(one->observe);
    Py_INCREF(one->inform);
    Py_INCREF(one->judge);
    Py_INCREF(one->complete);
    Py_INCREF(one->guard);
    if (self->pool.settings.count != 1) {
        PyErr_SetString(PyExc_ValueError, "the pool has more than one instance");
        return false;
    }
    one->inputs = calloc(self->pool.settings.inputs->count + 1, sizeof *one->inputs);
    if (one->inputs == NULL) {
        PyErr_NoMemory();
        return false;
    }
    if (!take_watched(one) || !take_observations(self, playing, seen, &one->turn) ||
        !take_bytes(rewards, &b[REWARDS], PyBUF_WRITABLE, sizeof(double)) ||
        !take_bytes(terminated, &b[TERMINATED], PyBUF_WRITABLE, 1) ||
        !take_bytes(truncated, &b[TRUNCATED], PyBUF_WRITABLE, 1)) {
        return false;
    }
    settle_turn(self, playing, &one->turn);
    return true;
}

/* Takes the parts that fmugym/pool/native.py describes. */
PyObject *py_prepare_one(PyObject *object, PyObject *args) {
    PyPool *self = (PyPool *)object;
    One *one = is_prepared(self) ? calloc(1, sizeof *one) : NULL;
    PyObject *before = self->one, *capsule = NULL;

    if (one == NULL) {
        return PyErr_Occurred() ? NULL : PyErr_NoMemory();
    }
    one->playing = Py_NewRef(self->playing);
    if (fill(self, one, args)) {
        capsule = PyCapsule_New(one, ONE, one_dealloc);
    }
    if (capsule == NULL) {
        one_free(one);
        return NULL;
    }
    self->one = capsule;
    Py_XDECREF(before);
    Py_RETURN_NONE;
}

/* Whether the environment still has the attributes that the programs were made of. */
static bool is_as_before(const One *one, PyObject *attributes) {
    bool same = true;

    for (size_t i = 0; i < one->number_of_watched && same; i++) {
        const Watched *w = &one->watched[i];
        same = PyDict_GetItemWithError(attributes, w->name) == w->value;
    }
    PyErr_Clear();
    return same;
}

typedef struct {
    One *one;
    const char *actions;
    int64_t number; /* an integer action */
    Py_buffer buffer;
    bool is_refused, is_troubled;
} Step;

static bool take_number(PyObject *action, Step *s) {
    PyObject *integer = PyBool_Check(action) ? NULL : PyNumber_Index(action);

    s->number = integer == NULL ? 0 : PyLong_AsLongLong(integer);
    s->actions = (const char *)&s->number;
    Py_XDECREF(integer);
    return integer != NULL && !PyErr_Occurred();
}

/* Takes an action of exactly the type and shape that the action space has. */
static bool take_action(const Playing *playing, PyObject *action, Step *s) {
    if (playing->form.play.actions.check == ACTIONS_IN_RANGE) {
        return take_number(action, s);
    }
    if (!take_array_of_actions(playing, action, 1, &s->buffer)) {
        return false;
    }
    s->actions = s->buffer.buf;
    return true;
}

static void do_one(PyPool *self, bool alone, void *context) {
    Step *s = context;
    PyTurn *t = &s->one->turn;

    t->turn.actions = s->actions;
    t->call.alone = alone;
    s->is_refused = play_has_bad_action(&t->turn, 1) || !play_makes_inputs(&t->turn, s->one->inputs);
    if (!s->is_refused) {
        s->is_troubled = pool_play(&self->pool, &t->call, &t->ends) > 0 || t->ends.outside;
    }
}

static PyObject *result_of(const One *one) {
    const Turn *turn = &one->turn.turn;
    PyObject *result = PyTuple_New(5), *observation = PyObject_CallNoArgs(one->observe);
    PyObject *info = one->inform == Py_None ? PyDict_New() : PyObject_CallNoArgs(one->inform);
    PyObject *reward = PyFloat_FromDouble(*turn->rewards);

    if (result == NULL || observation == NULL || info == NULL || reward == NULL) {
        Py_XDECREF(result);
        Py_XDECREF(observation);
        Py_XDECREF(info);
        Py_XDECREF(reward);
        return NULL;
    }
    PyTuple_SetItem(result, 0, observation);
    PyTuple_SetItem(result, 1, reward);
    PyTuple_SetItem(result, 2, PyBool_FromLong(*turn->terminated));
    PyTuple_SetItem(result, 3, PyBool_FromLong(*turn->truncated));
    PyTuple_SetItem(result, 4, info);
    return result;
}

/* What Python has to do when the pool has done its part. */
static PyObject *completed(const One *one, bool is_troubled) {
    if (is_troubled) {
        return PyObject_CallNoArgs(one->judge);
    }
    PyObject *result = result_of(one);
    if (result == NULL || one->complete == Py_None) {
        return result;
    }
    PyObject *whole = PyObject_CallFunctionObjArgs(one->complete, result, NULL);
    Py_DECREF(result);
    return whole;
}

static PyObject *step_with(PyPool *self, One *one, PyObject *action) {
    Step s = {.one = one};
    bool performed = true;

    s.is_refused = !take_action(playing_of(one->playing), action, &s);
    if (s.is_refused) {
        PyErr_Clear();
    } else {
        performed = perform(self, PLAY, do_one, &s);
    }
    release_buffer(&s.buffer);
    if (!performed || (!s.is_refused && !report_messages(self))) {
        return NULL;
    }
    if (s.is_refused) {
        Py_RETURN_NONE;
    }
    return completed(one, s.is_troubled);
}

/* After an exception, the episode does not go on. */
static PyObject *step_or_end(PyPool *self, One *one, PyObject *action, PyObject *attributes) {
    uint8_t *ended = playing_of(one->playing)->form.play.ended;

    if (*ended || !is_as_before(one, attributes)) {
        Py_RETURN_NONE;
    }
    PyObject *result = step_with(self, one, action);
    if (result == NULL) {
        *ended = 1;
    }
    return result;
}

/* Takes an action, and the attributes of the environment. Returns the result of the step; None if
 * nothing was done, because the episode has ended, or the action, the inputs that it makes or an
 * attribute are not as they should be. */
PyObject *py_step_one(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    PyObject *result = NULL;

    if (!has_arguments(nargs, 2)) {
        return NULL;
    }
    if (self->one == NULL || !PyDict_Check(args[1])) {
        PyErr_SetString(PyExc_TypeError, "step_one was not prepared, or gets no dict");
        return NULL;
    }
    PyObject *capsule = Py_NewRef(self->one);
    One *one = PyCapsule_GetPointer(capsule, ONE);
    if (guard_take(one->guard, "step")) {
        result = step_or_end(self, one, args[0], args[1]);
        guard_give_back(one->guard);
    }
    Py_DECREF(capsule);
    return result;
}
