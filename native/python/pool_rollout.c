/* The method of the type Pool for rollouts, in which each array has a row for each step: see
 * rollouts.h. */

#include "playing.h"

enum { OFFSETS = TURN_BUFFERS, ROLLOUT_ARGUMENTS };

typedef struct {
    PyTurn turn;
    size_t horizon;
    Py_buffer offsets;
} PyRollout;

static void do_rollout(PyPool *self, bool alone, void *context) {
    PyRollout *r = context;
    PyTurn *t = &r->turn;

    t->call.alone = alone;
    t->ends.outside = false;
    t->bad_action = play_has_bad_action(&t->turn, r->horizon);
    if (!t->bad_action) {
        t->troubled = pool_rollout(&self->pool, &t->call, r->horizon, &t->ends.outside);
    }
}

static bool take_rolled_observations(PyPool *self, const Playing *playing, PyObject *seen,
                                     PyRollout *r) {
    const Settings *s = &self->pool.settings;
    const size_t count = playing->form.judgement.program.number_of_seen;
    PyTurn *t = &r->turn;

    if (count == 0 && !PyTuple_Check(seen)) {
        return take_bytes(seen, &t->buffers[SEEN], PyBUF_WRITABLE,
                          r->horizon * s->count * s->num_observed * sizeof(float));
    }
    for (size_t i = 0; i < count; i++) {
        const size_t size = playing->form.judgement.seen_sizes[i];
        PyObject *array = PyTuple_Check(seen) ? PyTuple_GetItem(seen, (Py_ssize_t)i) : seen;
        if (array == NULL ||
            !take_bytes(array, &t->seen_buffers[i], PyBUF_WRITABLE,
                        r->horizon * s->count * size)) {
            return false;
        }
        t->seen[i] = t->seen_buffers[i].buf;
        t->seen_sizes[i] = size;
    }
    return true;
}

/* None at all stand for no offsets. */
static bool take_offsets(PyPool *self, PyObject *array, PyRollout *r) {
    const size_t size = self->pool.settings.outputs->count * sizeof(double);

    return PyObject_Length(array) == 0 || take_bytes(array, &r->offsets, PyBUF_SIMPLE, size);
}

static bool take_rollout(PyPool *self, const Playing *playing, PyObject *const *args,
                         PyRollout *r) {
    const Py_ssize_t n = (Py_ssize_t)self->pool.settings.count;
    const Actions *a = &playing->form.play.actions;
    Py_buffer *b = r->turn.buffers;

    if (!take_matrix(args[REWARDS], &b[REWARDS], WRITTEN, "rewards", ITEM_FLOAT64, ANY_LENGTH, n)) {
        return false;
    }
    const Py_ssize_t horizon = b[REWARDS].shape[0];
    r->horizon = (size_t)horizon;
    return take_bytes(args[ACTIONS], &b[ACTIONS], PyBUF_SIMPLE,
                      r->horizon * (size_t)n * a->elements * a->size) &&
           take_rolled_observations(self, playing, args[SEEN], r) &&
           take_matrix(args[TERMINATED], &b[TERMINATED], WRITTEN, "terminated", ITEM_BOOLEAN,
                       horizon, n) &&
           take_matrix(args[TRUNCATED], &b[TRUNCATED], WRITTEN, "truncated", ITEM_BOOLEAN, horizon,
                       n) &&
           take_offsets(self, args[OFFSETS], r);
}

static PyObject *roll_out(PyPool *self, PyObject *capsule, PyObject *const *args) {
    const Playing *playing = playing_of(capsule);
    PyRollout r = {.horizon = 0};
    bool done = false;

    clear_turn(playing, &r.turn);
    if (take_rollout(self, playing, args, &r)) {
        settle_turn(self, playing, &r.turn);
        r.turn.turn.offsets = r.offsets.buf;
        done = perform(self, NEVER_SHORT, do_rollout, &r) && !is_outside(&r.turn) &&
               report_messages(self);
    }
    if (done && r.turn.bad_action) {
        PyErr_SetString(PyExc_ValueError, "an action is out of range");
        done = false;
    }
    release_turn(playing, &r.turn);
    release_buffer(&r.offsets);
    return done ? PyLong_FromSize_t(r.turn.troubled) : NULL;
}

PyObject *py_rollout(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;

    if (!has_arguments(nargs, ROLLOUT_ARGUMENTS) || !is_prepared(self)) {
        return NULL;
    }
    PyObject *playing = Py_NewRef(self->playing);
    PyObject *result = roll_out(self, playing, args);
    Py_DECREF(playing);
    return result;
}
