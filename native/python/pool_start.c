/* The method of the type Pool that starts episodes outside of a step: see pool/play.h. */

#include "python/playing.h"

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

static void settle_reset(PyPool *self, const Playing *playing, const ResultArrays *arrays,
                         PyTurn *t) {
    const Results *r = playing->results;

    settle_turn(self, playing, t);
    t->call.mask = (Mask){arrays->memory[results_place(r, MASK_ARRAY)], 1};
    t->turn.drawn = (double *)(void *)arrays->memory[results_place(r, DRAWN_ARRAY)];
    t->turn.arrays = arrays->memory;
    if (pool_observes(playing)) {
        t->call.observations = (float *)(void *)arrays->memory[0];
    }
}

/* The memory is provided first: that may run code that changes the caller's mask. */
static PyObject *start_with(PyPool *self, PyObject *capsule, PyObject *mask) {
    const Playing *playing = playing_of(capsule);
    ResultArrays arrays;
    PyTurn t = {.bad_action = false};
    PyObject *result = NULL;

    if (results_provide_reset(playing->results, &arrays)) {
        if (!results_copy_mask(playing->results, mask, &arrays)) {
            result = Py_NewRef(Py_None);
        } else {
            settle_reset(self, playing, &arrays, &t);
            if (perform(self, RESET, do_start, &t) && !is_outside(&t) && report_messages(self)) {
                result = results_of_reset(playing->results, &arrays, t.troubled,
                                          t.ends.ended != 0);
            }
        }
    }
    results_drop(playing->results, &arrays);
    return result;
}

PyObject *py_start(PyObject *object, PyObject *mask) {
    PyPool *self = (PyPool *)object;

    if (!is_prepared(self)) {
        return NULL;
    }
    PyObject *playing = Py_NewRef(self->playing);
    PyObject *result = start_with(self, playing, mask);
    Py_DECREF(playing);
    return result;
}
