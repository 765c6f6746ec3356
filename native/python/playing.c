/* Preparing a pool to play: see pool/play.h. */

#include "python/playing.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

static const char *const PLAYING = "fmugym._native.playing";

Playing *playing_of(PyObject *capsule) {
    return PyCapsule_GetPointer(capsule, PLAYING);
}

static void playing_free(Playing *playing) {
    for (int i = 0; i < PLAY_BUFFERS; i++) {
        release_buffer(&playing->buffers[i]);
    }
    play_drop(&playing->form);
    release_rows(&playing->rows);
    Py_XDECREF(playing->start);
    Py_XDECREF(playing->draws);
    results_drop(&playing->results);
    free(playing);
}

static void playing_dealloc(PyObject *capsule) {
    playing_free(playing_of(capsule));
}

static void replace_reference(PyObject **place, PyObject *object) {
    PyObject *before = *place;

    *place = object;
    Py_XDECREF(before);
}

/* Preparing */

static bool take_starts(PyPool *self, Playing *playing, PyObject *start, PyObject *values) {
    if (!require_access(self, start)) {
        return false;
    }
    Py_INCREF(start);
    playing->start = start;
    return take_matrix(values, &playing->buffers[STARTS], WRITTEN, "start_values", ITEM_FLOAT64,
                       (Py_ssize_t)((PyAccess *)start)->access.count,
                       (Py_ssize_t)self->pool.settings.count);
}

static bool take_draws(PyPool *self, Playing *playing, PyObject *draws, PyObject *streams) {
    const Py_ssize_t n = (Py_ssize_t)self->pool.settings.count;

    if (!PyObject_TypeCheck(draws, draws_type)) {
        PyErr_SetString(PyExc_TypeError, "expected Draws");
        return false;
    }
    playing->draws = Py_NewRef(draws);
    playing->form.play.draws = &((PyDraws *)draws)->draws;
    return take_matrix(streams, &playing->buffers[STREAMS], WRITTEN, "streams", ITEM_UINT64, n,
                       STREAM_NUMBERS);
}

/* The arguments of prepare_play. */
typedef struct {
    const char *form;
    Py_ssize_t size;
    PyObject *rows, *start, *start_values, *current, *previous, *draws, *streams;
    PyObject *ended, *kept, *results;
} Parts;

static bool parse(PyObject *args, PyObject *kwargs, Parts *p) {
    static char *names[] = {"form",     "rows",  "start",   "start_values", "current", "previous",
                            "draws",    "streams", "ended", "kept",         "results", NULL};

    return PyArg_ParseTupleAndKeywords(args, kwargs, "$y#O!OOOOOOOOO:prepare_play", names, &p->form,
                                       &p->size, &PyTuple_Type, &p->rows, &p->start,
                                       &p->start_values, &p->current, &p->previous, &p->draws,
                                       &p->streams, &p->ended, &p->kept, &p->results);
}

static bool take_form(PyPool *self, Playing *playing, const Parts *p) {
    const Settings *s = &self->pool.settings;
    Play *play = &playing->form.play;
    const size_t parameters = ((PyAccess *)playing->start)->access.count;

    play->start_values = playing->buffers[STARTS].buf;
    if (!take_rows(p->rows, (Py_ssize_t)s->count, &playing->rows)) {
        return false;
    }
    const char *fault = play_take(&playing->form, s, p->form, (size_t)p->size, playing->rows.rows,
                                  playing->rows.count);
    if (fault == NULL && !draws_fit(play->draws, parameters)) {
        fault = "a draw is for no start value";
    }
    if (fault != NULL) {
        PyErr_Format(PyExc_ValueError, "the form of a play is damaged: %s", fault);
    }
    return fault == NULL;
}

/* The actions of this step, of any type and with the environments on the first axis; those before alike. */
static bool take_actions(PyPool *self, Playing *playing, const Parts *p) {
    Actions *a = &playing->form.play.actions;
    Py_buffer *current = &playing->buffers[CURRENT], *previous = &playing->buffers[PREVIOUS];
    const size_t count = self->pool.settings.count;
    const int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | PyBUF_WRITABLE;

    if (PyObject_GetBuffer(p->current, current, flags) < 0 ||
        PyObject_GetBuffer(p->previous, previous, flags) < 0) {
        return false;
    }
    playing->action_item = item_of(current);
    if (playing->action_item == ITEMS || current->ndim == 0 ||
        current->shape[0] != (Py_ssize_t)count || (size_t)current->itemsize != a->size ||
        (size_t)current->len != count * a->elements * a->size) {
        PyErr_SetString(PyExc_ValueError, "the memory for actions has another type or shape");
        return false;
    }
    a->current = current->buf;
    a->previous = previous->buf;
    return buffer_fits(previous, WRITTEN, "previous actions", playing->action_item, current->ndim,
                       current->shape);
}

static bool take_arrays(PyPool *self, Playing *playing, const Parts *p) {
    const Settings *s = &self->pool.settings;
    const Py_ssize_t n = (Py_ssize_t)s->count;
    Py_buffer *b = playing->buffers;

    if (!take_vector(p->ended, &b[ENDED], WRITTEN, "ended", ITEM_BOOLEAN, n) ||
        !take_matrix(p->kept, &b[KEPT], WRITTEN, "kept", ITEM_FLOAT64,
                     (Py_ssize_t)s->outputs->count, n)) {
        return false;
    }
    play_settle(&playing->form, s, b[KEPT].buf, b[ENDED].buf);
    playing->form.play.streams = b[STREAMS].buf;
    return true;
}

static bool results_fit(const PyPool *self, const Playing *playing) {
    const Settings *s = &self->pool.settings;
    const Results *r = &playing->results;
    const Play *play = &playing->form.play;
    const size_t drawn = play->draws->count * s->count * sizeof(double);
    bool fit = (s->count == 1 || !r->are_of_one) &&
               r->number_of_seen == play->number_of_seen &&
               r->makers[results_place(r, MASK_ARRAY)].size == s->count &&
               r->makers[results_place(r, DRAWN_ARRAY)].size == drawn;

    for (size_t i = 0; fit && i < MOST_ARRAYS; i++) {
        const size_t size = play->array_sizes[i];
        fit = i < play->number_of_arrays ? size > 0 && r->makers[i].size == s->count * size
                                         : size == 0;
    }
    return fit;
}

static bool take_results(PyPool *self, Playing *playing, PyObject *parts) {
    if (!results_take(&playing->results, parts)) {
        return false;
    }
    if (!results_fit(self, playing)) {
        PyErr_SetString(PyExc_ValueError, "the arrays of results do not fit the pool");
        return false;
    }
    return true;
}

/* What comes later refers to what comes first. */
static bool fill(PyPool *self, Playing *playing, PyObject *args, PyObject *kwargs) {
    Parts p;

    return parse(args, kwargs, &p) && take_starts(self, playing, p.start, p.start_values) &&
           take_draws(self, playing, p.draws, p.streams) && take_form(self, playing, &p) &&
           take_actions(self, playing, &p) && take_arrays(self, playing, &p) &&
           take_results(self, playing, p.results);
}

/* Always discards the previous preparation. A call that uses it keeps its own reference. */
PyObject *py_prepare_play(PyObject *object, PyObject *args, PyObject *kwargs) {
    PyPool *self = (PyPool *)object;
    Playing *playing = calloc(1, sizeof *playing);

    Py_CLEAR(self->playing);
    if (playing == NULL) {
        return PyErr_NoMemory();
    }
    PyObject *capsule =
        fill(self, playing, args, kwargs) ? PyCapsule_New(playing, PLAYING, playing_dealloc) : NULL;
    if (capsule == NULL) {
        playing_free(playing);
        return NULL;
    }
    replace_reference(&self->playing, capsule);
    Py_RETURN_NONE;
}
