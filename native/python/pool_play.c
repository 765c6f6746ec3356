/* The methods of the type Pool for playing: see pool/play.h. */

#include "python/playing.h"

#include <string.h>

static bool is_of_one(const Playing *playing) {
    return playing->results != NULL && results_are_of_one(playing->results);
}

static bool take_array(const Playing *playing, PyObject *actions, Py_buffer *b) {
    if (PyObject_GetBuffer(actions, b, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        return false;
    }
    const int first = is_of_one(playing) && b->ndim == playing->action_dimensions - 1;
    return buffer_fits(b, IN_PLACE, "the actions", playing->action_item,
                       playing->action_dimensions - first, playing->action_shape + first);
}

static bool take_integer(PyObject *action, PyTurn *t) {
    PyObject *integer = PyBool_Check(action) ? NULL : PyNumber_Index(action);

    t->number = integer == NULL ? 0 : PyLong_AsLongLong(integer);
    t->actions.buf = &t->number;
    Py_XDECREF(integer);
    if (integer == NULL || PyErr_Occurred()) {
        PyErr_SetString(PyExc_TypeError, "the action is no integer of 64 bits");
        return false;
    }
    return true;
}

bool take_actions_of_turn(const Playing *playing, PyObject *actions, PyTurn *t) {
    const bool is_discrete = playing->form.play.actions.check == ACTIONS_IN_RANGE;

    return is_discrete && is_of_one(playing) && !PySequence_Check(actions)
               ? take_integer(actions, t)
               : take_array(playing, actions, &t->actions);
}

void settle_turn(PyPool *self, const Playing *playing, PyTurn *t) {
    const Py_buffer *inputs = &self->buffers[INPUTS], *starts = &playing->buffers[STARTS];

    t->turn = (Turn){
        .play = &playing->form.play,
        .actions = t->actions.buf,
    };
    t->call = (Call){
        .inputs = {inputs->buf, inputs->strides[0], inputs->strides[1]},
        .start = &((PyAccess *)playing->start)->access,
        .start_values = {starts->buf, starts->strides[0], starts->strides[1]},
        .mask = {(const char *)playing->form.play.ended, 1},
        .turn = &t->turn,
    };
}

static void do_play(PyPool *self, bool alone, void *context) {
    PyTurn *t = context;

    t->call.alone = alone;
    t->bad_action = play_has_bad_action(&t->turn);
    if (!t->bad_action) {
        t->troubled = pool_play(&self->pool, &t->call, &t->ends);
    }
}

static void do_before(PyPool *self, bool alone, void *context) {
    PyTurn *t = context;

    t->call.alone = alone;
    t->ends.outside = false;
    t->bad_action = play_has_bad_action(&t->turn);
    if (!t->bad_action) {
        t->troubled = pool_play_before(&self->pool, &t->call);
    }
}

static void do_after(PyPool *self, bool alone, void *context) {
    PyTurn *t = context;

    t->call.alone = alone;
    t->troubled = pool_play_after(&self->pool, &t->call, &t->ends);
}

bool is_outside(const PyTurn *t) {
    if (t->ends.outside) {
        PyErr_SetString(PyExc_IndexError, "a hook looks up an index outside of its table");
    }
    return t->ends.outside;
}

/* Lets the step fill the arrays that it returns. */
static void settle_results(const Playing *playing, const ResultArrays *arrays, PyTurn *t) {
    t->turn.arrays = arrays->memory;
    if (pool_observes(playing)) {
        t->call.observations = (float *)(void *)arrays->memory[0];
    }
}

/* Lets episodes start where others have ended before this step. */
static void settle_starts(const Playing *playing, const ResultArrays *arrays, PyTurn *t) {
    const Results *r = playing->results;
    const Play *play = &playing->form.play;

    t->turn.drawn = (double *)(void *)arrays->memory[results_place(r, DRAWN_ARRAY)];
    memcpy(arrays->memory[results_place(r, MASK_ARRAY)], play->ended, play->count);
}

/* Lets them also start where others end in this step. */
static void settle_starts_at_ends(const Playing *playing, const ResultArrays *arrays, PyTurn *t) {
    t->turn.last = arrays->last_memory;
    t->turn.started = (uint8_t *)arrays->memory[results_place(playing->results, MASK_ARRAY)];
}

static PyObject *turn_result(const Playing *playing, const ResultArrays *arrays, const PyTurn *t) {
    const bool at_ends = t->turn.started != NULL;
    const bool any_started = at_ends ? t->ends.started > 0 : t->turn.drawn != NULL;

    return results_of_step(playing->results, arrays, t->troubled, t->ends.ended > t->ends.started,
                           any_started, at_ends);
}

static void raise_bad_action(void) {
    PyErr_SetString(PyExc_ValueError, "an action is out of range");
}

static bool play_turn(PyPool *self, int operation, PyTurn *t) {
    static Work *const works[OPERATIONS] = {
        [PLAY] = do_play, [BEFORE] = do_before, [AFTER] = do_after};

    if (!perform(self, operation, works[operation], t)) {
        return false;
    }
    if (t->bad_action) {
        raise_bad_action();
        return false;
    }
    return !is_outside(t) && report_messages(self);
}

/* What comes before the FMUs' part fills nothing that it returns. */
static PyObject *play_before_with(PyPool *self, PyObject *capsule, PyObject *actions) {
    const Playing *playing = playing_of(capsule);
    PyTurn t = {.bad_action = false};
    bool done = false;

    if (take_actions_of_turn(playing, actions, &t)) {
        settle_turn(self, playing, &t);
        done = play_turn(self, BEFORE, &t);
    }
    release_buffer(&t.actions);
    return done ? Py_NewRef(Py_None) : NULL;
}

static bool provide(Results *results, bool starts, bool at_ends, ResultArrays *arrays) {
    return results_provide_step(results, arrays) &&
           (!starts || results_provide_starts(results, at_ends, arrays));
}

static void settle_step(PyPool *self, const Playing *playing, bool starts, bool at_ends,
                        const ResultArrays *arrays, PyTurn *t) {
    settle_turn(self, playing, t);
    settle_results(playing, arrays, t);
    if (starts) {
        settle_starts(playing, arrays, t);
    }
    if (at_ends) {
        settle_starts_at_ends(playing, arrays, t);
    }
}

/* Reads where episodes have ended before it enters the pool. Those that another thread ends in between
 * start with the values of earlier draws. */
static PyObject *play_with(PyPool *self, int operation, PyObject *capsule, PyObject *actions,
                           bool at_ends) {
    const Playing *playing = playing_of(capsule);
    const Play *play = &playing->form.play;
    const bool starts =
        operation == PLAY && (at_ends || memchr(play->ended, 1, play->count) != NULL);
    ResultArrays arrays;
    PyTurn t = {.bad_action = false};
    PyObject *result = NULL;

    if (provide(playing->results, starts, at_ends, &arrays) &&
        take_actions_of_turn(playing, actions, &t)) {
        settle_step(self, playing, starts, at_ends, &arrays, &t);
        result = play_turn(self, operation, &t) ? turn_result(playing, &arrays, &t) : NULL;
    }
    results_drop(playing->results, &arrays);
    release_buffer(&t.actions);
    return result;
}

bool is_prepared(const PyPool *self) {
    if (self->playing == NULL) {
        PyErr_SetString(PyExc_ValueError, "play was not prepared");
    }
    return self->playing != NULL;
}

/* Keeps what was prepared alive while it plays. */
static PyObject *play_by(PyObject *object, int operation, PyObject *actions, bool at_ends) {
    PyPool *self = (PyPool *)object;

    if (!is_prepared(self)) {
        return NULL;
    }
    PyObject *playing = Py_NewRef(self->playing);
    PyObject *result = operation == BEFORE
                           ? play_before_with(self, playing, actions)
                           : play_with(self, operation, playing, actions, at_ends);
    Py_DECREF(playing);
    return result;
}

/* Nothing but the check of the actions that every step begins with. */
PyObject *py_check_actions(PyObject *object, PyObject *actions) {
    PyPool *self = (PyPool *)object;
    PyTurn t = {.bad_action = false};

    if (!is_prepared(self)) {
        return NULL;
    }
    PyObject *capsule = Py_NewRef(self->playing);
    const Playing *playing = playing_of(capsule);
    bool good = take_actions_of_turn(playing, actions, &t);
    if (good) {
        settle_turn(self, playing, &t);
        good = !play_has_bad_action(&t.turn);
        if (!good) {
            raise_bad_action();
        }
    }
    release_buffer(&t.actions);
    Py_DECREF(capsule);
    return good ? Py_NewRef(Py_None) : NULL;
}

PyObject *py_play(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    return has_arguments(nargs, 2) ? play_by(object, PLAY, args[0], args[1] == Py_True) : NULL;
}

PyObject *py_play_before(PyObject *object, PyObject *actions) {
    return play_by(object, BEFORE, actions, false);
}

PyObject *py_play_after(PyObject *object, PyObject *actions) {
    return play_by(object, AFTER, actions, false);
}
