/* The step of a single environment: that of a batch of one, with numbers for arrays of one. */

#include "playing.h"

/* The arguments of step_one; see Pool.step_one in fmugym/_native.pyi. */
enum { JUDGE, COMPLETE, ACTION, ARGUMENTS };

typedef struct {
    PyTurn turn;
    int64_t number; /* an integer action */
    bool is_refused;
} Step;

/* Takes an action of exactly the type and shape that the action space has. */
static bool take_action(const Playing *playing, PyObject *action, Step *s) {
    Py_buffer *buffer = &s->turn.buffers[ACTIONS];

    if (playing->form.play.actions.check != ACTIONS_IN_RANGE) {
        return take_array_of_actions(playing, action, 1, buffer);
    }
    PyObject *integer = PyBool_Check(action) ? NULL : PyNumber_Index(action);
    s->number = integer == NULL ? 0 : PyLong_AsLongLong(integer);
    buffer->buf = &s->number;
    Py_XDECREF(integer);
    return integer != NULL && !PyErr_Occurred();
}

static void do_one(PyPool *self, bool alone, void *context) {
    Step *s = context;
    PyTurn *t = &s->turn;

    t->call.alone = alone;
    s->is_refused = play_has_bad_action(&t->turn, 1) || !play_makes_inputs(&t->turn);
    if (!s->is_refused) {
        t->troubled = pool_play(&self->pool, &t->call, &t->ends);
    }
}

/* Python judges again what is in trouble, and completes what has no program. */
static PyObject *result_of(const Playing *playing, const ResultArrays *arrays, const PyTurn *t,
                           PyObject *const *args) {
    if (t->troubled > 0 || t->ends.outside) {
        return PyObject_CallNoArgs(args[JUDGE]);
    }
    PyObject *result = results_of_step(playing->results, arrays, false, false);
    if (result == NULL) {
        return NULL;
    }
    PyTuple_SetItem(result, 1, PyFloat_FromDouble(*t->turn.rewards));
    PyTuple_SetItem(result, 2, PyBool_FromLong(*t->turn.terminated));
    PyTuple_SetItem(result, 3, PyBool_FromLong(*t->turn.truncated));
    if (args[COMPLETE] == Py_None) {
        return result;
    }
    PyObject *whole = PyObject_CallFunctionObjArgs(args[COMPLETE], result, NULL);
    Py_DECREF(result);
    return whole;
}

/* Returns the result of the step; None if nothing was done, because the episode has ended, or the
 * action or the inputs that it makes are not as they should be. After an exception, the episode does
 * not go on. */
static PyObject *step_with(PyPool *self, const Playing *playing, PyObject *const *args) {
    uint8_t *ended = playing->form.play.ended;
    ResultArrays arrays;
    Step s;
    PyObject *result = NULL;

    clear_turn(playing, &s.turn);
    s.is_refused = *ended || !take_action(playing, args[ACTION], &s);
    PyErr_Clear();
    if (results_provide_step(playing->results, &arrays)) {
        settle_turn(self, playing, &s.turn);
        settle_results(playing, &arrays, &s.turn);
        if (s.is_refused || (perform(self, PLAY, do_one, &s) && report_messages(self))) {
            result = s.is_refused ? Py_NewRef(Py_None)
                                  : result_of(playing, &arrays, &s.turn, args);
        }
    }
    *ended |= result == NULL;
    results_drop(playing->results, &arrays);
    release_turn(playing, &s.turn);
    return result;
}

PyObject *py_step_one(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;

    if (!has_arguments(nargs, ARGUMENTS) || !is_prepared(self) || !has_results(self)) {
        return NULL;
    }
    if (self->pool.settings.count != 1) {
        PyErr_SetString(PyExc_TypeError, "step_one needs one instance");
        return NULL;
    }
    PyObject *capsule = Py_NewRef(self->playing);
    PyObject *result = step_with(self, playing_of(capsule), args);
    Py_DECREF(capsule);
    return result;
}
