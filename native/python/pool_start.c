/* The method of the type Pool that starts episodes outside of a step: see play.h. */

#include "playing.h"

#include <string.h>

/* Sets ended to 1 if any episode is at its end now, 0 otherwise. */
static void do_start(PyPool *self, bool alone, void *context) {
    PyTurn *t = context;
    const Play *play = t->turn.play;

    t->call.alone = alone;
    t->ends.outside = false;
    t->troubled = pool_start(&self->pool, &t->call, &t->ends.outside);
    t->ends.ended = memchr(play->ended, 1, play->count) != NULL;
}

/* The arguments: a mask, the memory of the drawn values, and the arrays of observations and infos. */
static PyObject *start_with(PyPool *self, const Playing *playing, PyObject *const *args) {
    PyTurn t;
    PyObject *result = NULL;

    clear_turn(playing, &t);
    if (take_start(self, playing, args[0], args[1], &t) &&
        take_seen_arrays(self, playing, args[2], t.seen_buffers, t.seen)) {
        settle_turn(self, playing, &t);
        t.call.mask = (Mask){t.buffers[MASK].buf, 1};
        if (perform(self, RESET, do_start, &t) && !is_outside(&t) && report_messages(self)) {
            result = Py_BuildValue("nO", (Py_ssize_t)t.troubled,
                                   t.ends.ended != 0 ? Py_True : Py_False);
        }
    }
    release_turn(playing, &t);
    return result;
}

PyObject *py_start(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;

    if (!has_arguments(nargs, 3) || !is_prepared(self)) {
        return NULL;
    }
    PyObject *playing = Py_NewRef(self->playing);
    PyObject *result = start_with(self, playing_of(playing), args);
    Py_DECREF(playing);
    return result;
}
