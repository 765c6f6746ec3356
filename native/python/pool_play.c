/* The methods of the type Pool for playing: see pool/play.h. */

#include "python/playing.h"

#include <string.h>

/* One call that plays. */
typedef struct {
    PyObject *capsule; /* keeps what was prepared alive */
    Playing *playing; /* only the arrays of its results change */
    int64_t number; /* the action of the only environment, if it is an integer */
    int operation; /* PLAY, BEFORE, AFTER or RESET */
    Turn turn;
    Call call;
    bool bad_action;
    size_t troubled;
    Ends ends;
} PyTurn;

/* Lets a turn and its call refer to what was prepared. Returns false with an exception if nothing was. */
static bool begin_turn(PyPool *self, PyTurn *t) {
    if (self->playing == NULL) {
        PyErr_SetString(PyExc_ValueError, "play was not prepared");
        return false;
    }
    t->capsule = Py_NewRef(self->playing);
    t->playing = playing_of(t->capsule);
    const Play *play = &t->playing->form.play;
    t->turn.play = play;
    t->call = (Call){
        .inputs = self->inputs,
        .start = t->playing->start,
        .start_values = t->playing->start_values,
        .mask = {(const char *)play->ended, 1},
        .turn = &t->turn,
    };
    return true;
}

/* Actions. Those of another type or shape come back as an exception; the caller then converts them. */

static bool take_array(PyArrayObject *actions, PyTurn *t) {
    PyArrayObject *kept = t->playing->actions;

    if (!require_any_array(actions, "the actions")) {
        return false;
    }
    const int dimensions = PyArray_NDIM(kept);
    const int first = t->playing->results.are_of_one && PyArray_NDIM(actions) == dimensions - 1;
    t->turn.actions = PyArray_BYTES(actions);
    return require_array(actions, "the actions", PyArray_TYPE(kept), NPY_ARRAY_CARRAY_RO,
                         dimensions - first, PyArray_DIMS(kept) + first);
}

static bool take_integer(PyObject *action, PyTurn *t) {
    PyObject *integer = PyBool_Check(action) ? NULL : PyNumber_Index(action);

    t->number = integer == NULL ? 0 : PyLong_AsLongLong(integer);
    t->turn.actions = (const char *)&t->number;
    Py_XDECREF(integer);
    if (integer == NULL || PyErr_Occurred()) {
        PyErr_SetString(PyExc_TypeError, "the action is no integer of 64 bits");
        return false;
    }
    return true;
}

/* Takes an array of actions, or the action of the only environment: an array, or an integer. */
static bool take_actions(PyObject *actions, PyTurn *t) {
    const bool is_discrete = t->turn.play->actions.check == ACTIONS_IN_RANGE;

    return is_discrete && t->playing->results.are_of_one && !PySequence_Check(actions)
               ? take_integer(actions, t)
               : take_array((PyArrayObject *)actions, t);
}

static bool require_good_actions(bool are_bad) {
    if (are_bad) {
        PyErr_SetString(PyExc_ValueError, "an action is out of range or NaN");
    }
    return !are_bad;
}

/* Nothing but the check of the actions that every step begins with. */
PyObject *py_check_actions(PyObject *object, PyObject *actions) {
    PyTurn t = {.bad_action = false};
    const bool good = begin_turn((PyPool *)object, &t) && take_actions(actions, &t) &&
                      require_good_actions(play_has_bad_action(&t.turn));

    Py_XDECREF(t.capsule);
    return good ? Py_NewRef(Py_None) : NULL;
}

/* Work inside of the pool */

static void do_turn(PyPool *self, bool alone, void *context) {
    PyTurn *t = context;
    Pool *pool = &self->pool;

    t->call.alone = alone;
    t->bad_action = t->turn.actions != NULL && play_has_bad_action(&t->turn);
    if (t->bad_action) {
        return;
    }
    switch (t->operation) {
    case BEFORE:
        pool_play_before(pool, &t->call);
        break;
    case AFTER:
        t->troubled = pool_play_after(pool, &t->call, &t->ends);
        break;
    case RESET:
        t->troubled = pool_start(pool, &t->call, &t->ends);
        break;
    default:
        t->troubled = pool_play(pool, &t->call, &t->ends);
    }
}

/* Returns false with an exception if the result cannot be used. */
static bool play_turn(PyPool *self, PyTurn *t) {
    if (!perform(self, t->operation, do_turn, t) || !require_good_actions(t->bad_action)) {
        return false;
    }
    if (t->ends.outside) {
        PyErr_SetString(PyExc_IndexError, "a hook looks up an index outside of its table");
        return false;
    }
    return report_messages(self);
}

/* Lets a turn fill the arrays that it returns. */
static void settle_results(const ResultArrays *arrays, PyTurn *t) {
    t->turn.arrays = arrays->memory;
    if (t->playing->form.pool_observes) {
        t->call.observations = (float *)(void *)arrays->memory[0];
    }
}

static char *memory_of(const PyTurn *t, const ResultArrays *arrays, size_t other) {
    return arrays->memory[results_place(&t->playing->results, other)];
}

/* Lets episodes start where others have ended before this step, and at_ends also where others end in
 * it. Those that another thread ends in between start with the values of earlier draws. */
static void settle_starts(const ResultArrays *arrays, bool at_ends, PyTurn *t) {
    const Play *play = t->turn.play;
    char *mask = memory_of(t, arrays, MASK_ARRAY);

    t->turn.drawn = (double *)(void *)memory_of(t, arrays, DRAWN_ARRAY);
    memcpy(mask, play->ended, play->count);
    if (at_ends) {
        t->turn.last = arrays->memory + results_place(&t->playing->results, LAST_ARRAYS);
        t->turn.started = (uint8_t *)mask;
    }
}

static PyObject *result_of(const PyTurn *t, const ResultArrays *arrays) {
    const bool at_ends = t->turn.started != NULL;
    const bool any_started = at_ends ? t->ends.started > 0 : t->turn.drawn != NULL;

    return results_of_step(&t->playing->results, arrays, t->troubled,
                           t->ends.ended > t->ends.started, any_started, at_ends);
}

static PyObject *step_with(PyPool *self, bool at_ends, PyTurn *t) {
    const Play *play = t->turn.play;
    Results *results = &t->playing->results;
    const bool starts =
        t->operation == PLAY && (at_ends || memchr(play->ended, 1, play->count) != NULL);
    ResultArrays arrays;
    PyObject *result = NULL;

    if (results_provide_step(results, &arrays) &&
        (!starts || results_provide_starts(results, at_ends, &arrays))) {
        settle_results(&arrays, t);
        if (starts) {
            settle_starts(&arrays, at_ends, t);
        }
        result = play_turn(self, t) ? result_of(t, &arrays) : NULL;
    }
    results_release(results, &arrays);
    return result;
}

/* Methods */

PyObject *py_play(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    PyTurn t = {.operation = PLAY};
    PyObject *result = require_arguments(nargs, 2) && begin_turn(self, &t) &&
                               take_actions(args[0], &t)
                           ? step_with(self, args[1] == Py_True, &t)
                           : NULL;

    Py_XDECREF(t.capsule);
    return result;
}

/* What comes before the FMUs' part fills nothing that it returns. */
PyObject *py_play_before(PyObject *object, PyObject *actions) {
    PyPool *self = (PyPool *)object;
    PyTurn t = {.operation = BEFORE};
    const bool done = begin_turn(self, &t) && take_actions(actions, &t) && play_turn(self, &t);

    Py_XDECREF(t.capsule);
    return done ? Py_NewRef(Py_None) : NULL;
}

PyObject *py_play_after(PyObject *object, PyObject *unused) {
    PyPool *self = (PyPool *)object;
    PyTurn t = {.operation = AFTER};
    PyObject *result = begin_turn(self, &t) ? step_with(self, false, &t) : NULL;

    (void)unused;
    Py_XDECREF(t.capsule);
    return result;
}

/* The memory is provided first: that may run code that changes the caller's mask. */
static PyObject *start_with(PyPool *self, PyObject *mask, PyTurn *t) {
    Results *results = &t->playing->results;
    ResultArrays arrays;
    PyObject *result = NULL;

    if (results_provide_reset(results, &arrays)) {
        if (!results_copy_mask(results, mask, &arrays)) {
            result = Py_NewRef(Py_None);
        } else {
            settle_results(&arrays, t);
            t->call.mask = (Mask){memory_of(t, &arrays, MASK_ARRAY), 1};
            t->turn.drawn = (double *)(void *)memory_of(t, &arrays, DRAWN_ARRAY);
            result = play_turn(self, t)
                         ? results_of_reset(results, &arrays, t->troubled, t->ends.ended > 0)
                         : NULL;
        }
    }
    results_release(results, &arrays);
    return result;
}

PyObject *py_start(PyObject *object, PyObject *mask) {
    PyPool *self = (PyPool *)object;
    PyTurn t = {.operation = RESET};
    PyObject *result = begin_turn(self, &t) ? start_with(self, mask, &t) : NULL;

    Py_XDECREF(t.capsule);
    return result;
}
