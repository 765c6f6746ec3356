/* Preparing a pool to play: see pool/play.h. */

#include "python/playing.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

static const char *const PLAYING = "fmugym._native.playing";

Playing *playing_of(PyObject *capsule) {
    return PyCapsule_GetPointer(capsule, PLAYING);
}

static void free_playing(PyObject *capsule) {
    Playing *playing = playing_of(capsule);

    play_drop(&playing->form);
    free(playing->rows);
    results_drop(&playing->results);
    Py_XDECREF(playing->args);
    free(playing);
}

static void replace_reference(PyObject **place, PyObject *object) {
    PyObject *before = *place;

    *place = object;
    Py_XDECREF(before);
}

/* Preparing */

/* The arguments of prepare_play; the form of draws comes with the addresses of two functions. */
typedef struct {
    PyObject *form, *rows, *start, *draws, *patterns;
    unsigned long long standard_normal, exponential;
    int are_of_one;
    PyArrayObject *start_values, *current, *previous, *streams, *ended, *kept;
} Parts;

static bool parse(PyObject *args, Parts *p) {
    return PyArg_ParseTuple(args, "SO!OOOO(SKK)OOO(pO!):prepare_play", &p->form, &PyTuple_Type,
                            &p->rows, &p->start, &p->start_values, &p->current, &p->previous,
                            &p->draws, &p->standard_normal, &p->exponential, &p->streams, &p->ended,
                            &p->kept, &p->are_of_one, &PyTuple_Type, &p->patterns);
}

static bool take_starts(PyPool *self, Playing *playing, const Parts *p) {
    const npy_intp n = (npy_intp)self->pool.settings.count;
    const Access *start = require_access(self, p->start);

    if (start == NULL ||
        !require_matrix(p->start_values, "start values", NPY_DOUBLE, NPY_ARRAY_CARRAY,
                        (npy_intp)start->count, n) ||
        !take_draws(p->draws, p->standard_normal, p->exponential, &playing->draws) ||
        !require_starts(&playing->draws, (npy_intp)start->count) ||
        !require_matrix(p->streams, "streams", NPY_UINT64, NPY_ARRAY_CARRAY, n, STREAM_NUMBERS)) {
        return false;
    }
    playing->start = start;
    playing->start_values = matrix_of(p->start_values);
    return true;
}

static bool take_form(PyPool *self, Playing *playing, const Parts *p) {
    const Settings *s = &self->pool.settings;

    playing->rows = take_rows(p->rows, (npy_intp)s->count);
    playing->form.play.draws = &playing->draws;
    return playing->rows != NULL &&
           require_no_fault("a play",
                            play_take(&playing->form, s, PyBytes_AsString(p->form),
                                      (size_t)PyBytes_Size(p->form), playing->rows,
                                      (size_t)PyTuple_Size(p->rows)));
}

/* The actions of this step, of any type and with the environments on the first axis; those before alike. */
static bool take_actions(PyPool *self, Playing *playing, const Parts *p) {
    const npy_intp count = (npy_intp)self->pool.settings.count;
    Actions *a = &playing->form.play.actions;
    PyArrayObject *current = p->current;

    if (!require_any_array(current, "actions")) {
        return false;
    }
    if (PyArray_NDIM(current) == 0 || PyArray_DIM(current, 0) != count ||
        (size_t)PyArray_ITEMSIZE(current) != a->size ||
        (size_t)PyArray_SIZE(current) != (size_t)count * a->elements ||
        !PyArray_ISCARRAY(current)) {
        PyErr_SetString(PyExc_ValueError, "the memory for actions has another type or shape");
        return false;
    }
    if (!require_array(p->previous, "previous actions", PyArray_TYPE(current), NPY_ARRAY_CARRAY,
                       PyArray_NDIM(current), PyArray_DIMS(current))) {
        return false;
    }
    playing->actions = current;
    a->current = PyArray_BYTES(current);
    a->previous = PyArray_BYTES(p->previous);
    return true;
}

static bool take_arrays(PyPool *self, Playing *playing, const Parts *p) {
    const Settings *s = &self->pool.settings;
    const npy_intp n = (npy_intp)s->count;
    Play *play = &playing->form.play;

    if (!require_vector(p->ended, "ended", NPY_BOOL, NPY_ARRAY_CARRAY, n) ||
        !require_matrix(p->kept, "kept", NPY_DOUBLE, NPY_ARRAY_CARRAY,
                        (npy_intp)s->outputs->count, n)) {
        return false;
    }
    play_settle(&playing->form, s, PyArray_DATA(p->kept), PyArray_DATA(p->ended));
    play->start_values = PyArray_DATA(p->start_values);
    play->streams = PyArray_DATA(p->streams);
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

static bool take_results(PyPool *self, Playing *playing, const Parts *p) {
    if (!results_take(&playing->results, p->are_of_one != 0, p->patterns)) {
        return false;
    }
    if (!results_fit(self, playing)) {
        PyErr_SetString(PyExc_ValueError, "the arrays of results do not fit the pool");
        return false;
    }
    return true;
}

/* What comes later refers to what comes first. */
static bool fill(PyPool *self, Playing *playing, PyObject *args) {
    Parts p;

    playing->args = Py_NewRef(args);
    return parse(args, &p) && take_starts(self, playing, &p) && take_form(self, playing, &p) &&
           take_actions(self, playing, &p) && take_arrays(self, playing, &p) &&
           take_results(self, playing, &p);
}

/* Always discards the previous preparation. A call that uses it keeps its own reference. */
PyObject *py_prepare_play(PyObject *object, PyObject *args) {
    PyPool *self = (PyPool *)object;
    Playing *playing = calloc(1, sizeof *playing);
    PyObject *capsule = playing == NULL ? PyErr_NoMemory()
                                        : PyCapsule_New(playing, PLAYING, free_playing);

    Py_CLEAR(self->playing);
    if (capsule == NULL) {
        free(playing);
        return NULL;
    }
    if (!fill(self, playing, args)) {
        Py_DECREF(capsule);
        return NULL;
    }
    replace_reference(&self->playing, capsule);
    Py_RETURN_NONE;
}
