/* The methods of the type Pool for playing: see play.h. */

#include "playing.h"

#include <stdint.h>
#include <string.h>

/* For arrays that the caller has just made. To tell their types, numpy would describe them in text,
 * which takes as long as all other checks together. */
bool take_bytes(PyObject *object, Py_buffer *buffer, int flags, size_t size) {
    if (PyObject_GetBuffer(object, buffer, PyBUF_C_CONTIGUOUS | flags) < 0) {
        return false;
    }
    if ((size_t)buffer->len != size) {
        PyErr_Format(PyExc_ValueError, "an array has %zd bytes, expected %zu", buffer->len, size);
    }
    return (size_t)buffer->len == size;
}

/* Whether the items of a buffer are of numpy's type with this letter; it has two for int64. */
static bool has_letter(const Py_buffer *buffer, int letter) {
    const char *format = buffer->format == NULL ? "B" : buffer->format;

    if (*format == '@' || *format == '=') {
        format++;
    }
    const bool is_long = *format == 'l' && letter == 'q'; /* of 8 bytes, as the caller sees */
    return *format != '\0' && format[1] == '\0' && (*format == letter || is_long);
}

bool take_array_of_actions(const Playing *playing, PyObject *actions, Py_buffer *b) {
    if (PyObject_GetBuffer(actions, b, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        return false;
    }
    bool fits = b->ndim == playing->action_dimensions &&
                has_letter(b, playing->action_letter) &&
                b->itemsize == (Py_ssize_t)playing->form.play.actions.size;
    for (int i = 0; fits && i < b->ndim; i++) {
        fits = b->shape[i] == playing->action_shape[i];
    }
    if (!fits || (uintptr_t)b->buf % (uintptr_t)b->itemsize != 0) {
        PyErr_SetString(PyExc_TypeError, "the actions have another type or shape");
        return false;
    }
    return true;
}

/* The arrays of observations and infos, whose memory a step or a start fills. */
bool take_seen_arrays(PyPool *self, const Playing *playing, PyObject *arrays, Py_buffer *buffers,
               char **seen) {
    const Settings *s = &self->pool.settings;
    const size_t count = number_of_seen(playing);

    if (!PyTuple_Check(arrays) || (size_t)PyTuple_Size(arrays) != count) {
        PyErr_Format(PyExc_TypeError, "expected a tuple of %zu arrays", count);
        return false;
    }
    for (size_t i = 0; i < count; i++) {
        const size_t size = playing->observes ? s->num_observed * sizeof(float)
                                              : playing->form.judgement.seen_sizes[i];
        if (!take_bytes(PyTuple_GetItem(arrays, (Py_ssize_t)i), &buffers[i], PyBUF_WRITABLE,
                        s->count * size)) {
            return false;
        }
        seen[i] = buffers[i].buf;
    }
    return true;
}

bool take_start(const PyPool *self, const Playing *playing, PyObject *mask, PyObject *drawn,
                PyTurn *t) {
    const size_t count = self->pool.settings.count;

    return take_bytes(mask, &t->buffers[MASK], PyBUF_WRITABLE, count) &&
           take_bytes(drawn, &t->buffers[DRAWN], PyBUF_WRITABLE,
                      playing->form.play.draws->count * count * sizeof(double));
}

/* Rewards, terminated, truncated, and the arrays of observations and infos. */
static bool take_judged(PyPool *self, const Playing *playing, PyObject *const *arrays, PyTurn *t) {
    const size_t count = self->pool.settings.count;

    return take_bytes(arrays[0], &t->buffers[REWARDS], PyBUF_WRITABLE, count * sizeof(double)) &&
           take_bytes(arrays[1], &t->buffers[TERMINATED], PyBUF_WRITABLE, count) &&
           take_bytes(arrays[2], &t->buffers[TRUNCATED], PyBUF_WRITABLE, count) &&
           take_seen_arrays(self, playing, arrays[3], t->seen_buffers, t->seen);
}

/* None if no episode may start; a mask and the drawn values; and a tuple of arrays like those of
 * observations and infos, for the last ones, if episodes start where others end. */
static bool take_starts_of_step(PyPool *self, const Playing *playing, PyObject *starts,
                                PyTurn *t) {
    if (starts == Py_None) {
        return true;
    }
    const Py_ssize_t size = PyTuple_Check(starts) ? PyTuple_Size(starts) : 0;
    if (size != 2 && size != 3) {
        PyErr_SetString(PyExc_TypeError, "expected a tuple of two or three for the starts");
        return false;
    }
    t->starts_at_ends = size == 3;
    return take_start(self, playing, PyTuple_GetItem(starts, 0), PyTuple_GetItem(starts, 1), t) &&
           (size == 2 ||
            take_seen_arrays(self, playing, PyTuple_GetItem(starts, 2), t->last_buffers, t->last));
}

void settle_turn(PyPool *self, const Playing *playing, PyTurn *t) {
    const Py_buffer *b = t->buffers;
    const Py_buffer *inputs = &self->buffers[INPUTS], *starts = &playing->buffers[STARTS];

    t->turn = (Turn){
        .play = &playing->form.play,
        .actions = b[ACTIONS].buf,
        .rewards = b[REWARDS].buf,
        .terminated = b[TERMINATED].buf,
        .truncated = b[TRUNCATED].buf,
        .seen = t->seen,
        .seen_sizes = playing->form.judgement.seen_sizes,
        .drawn = b[DRAWN].buf,
    };
    t->call = (Call){
        .inputs = {inputs->buf, inputs->strides[0], inputs->strides[1]},
        .start = &((PyAccess *)playing->start)->access,
        .start_values = {starts->buf, starts->strides[0], starts->strides[1]},
        .mask = {(const char *)playing->form.play.ended, 1},
        .observations = playing->observes ? (float *)(void *)t->seen[0] : NULL,
        .turn = &t->turn,
    };
    if (t->starts_at_ends) {
        t->turn.started = b[MASK].buf;
        t->turn.last_seen = t->last;
        t->turn.last_observations = playing->observes ? (float *)(void *)t->last[0] : NULL;
    }
}

static void do_play(PyPool *self, bool alone, void *context) {
    PyTurn *t = context;

    t->call.alone = alone;
    t->bad_action = play_has_bad_action(&t->turn, 1);
    if (!t->bad_action) {
        t->troubled = pool_play(&self->pool, &t->call, &t->ends);
    }
}

static void do_before(PyPool *self, bool alone, void *context) {
    PyTurn *t = context;

    t->call.alone = alone;
    t->ends.outside = false;
    t->bad_action = play_has_bad_action(&t->turn, 1);
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

size_t number_of_seen(const Playing *playing) {
    return playing->observes ? 1 : playing->form.judgement.program.number_of_seen;
}

void clear_turn(const Playing *playing, PyTurn *t) {
    const size_t size = number_of_seen(playing) * sizeof(Py_buffer);

    t->bad_action = t->starts_at_ends = false;
    t->seen[0] = NULL;
    memset(t->buffers, 0, sizeof t->buffers);
    memset(t->seen_buffers, 0, size);
    memset(t->last_buffers, 0, size);
}

void release_turn(const Playing *playing, PyTurn *t) {
    for (int i = 0; i < TURN_BUFFERS; i++) {
        release_buffer(&t->buffers[i]);
    }
    for (size_t i = 0; i < number_of_seen(playing); i++) {
        release_buffer(&t->seen_buffers[i]);
        release_buffer(&t->last_buffers[i]);
    }
}

/* How many instances had trouble, whether any episode is at its end now, and how many have started
 * where others have ended. */
static PyObject *told_of(const PyTurn *t) {
    PyObject *tuple = PyTuple_New(3);

    if (tuple != NULL) {
        PyTuple_SetItem(tuple, 0, PyLong_FromSize_t(t->troubled));
        PyTuple_SetItem(tuple, 1, PyBool_FromLong(t->ends.ended > t->ends.started));
        PyTuple_SetItem(tuple, 2, PyLong_FromSize_t(t->ends.started));
    }
    return tuple;
}

bool is_prepared(const PyPool *self) {
    if (self->playing == NULL) {
        PyErr_SetString(PyExc_ValueError, "play was not prepared");
    }
    return self->playing != NULL;
}

/* The arguments of a step: the actions, what take_judged takes, and what take_starts_of_step does. */
enum { GIVEN_ACTIONS, GIVEN_ARRAYS, GIVEN_STARTS = GIVEN_ARRAYS + 4, GIVEN };

/* Takes so many of these arguments, and does a part of a step, or all of it. */
static PyObject *play_with(PyPool *self, int operation, const Playing *playing,
                           PyObject *const *args, Py_ssize_t count) {
    PyTurn t;
    PyObject *result = NULL;

    clear_turn(playing, &t);
    if (take_array_of_actions(playing, args[GIVEN_ACTIONS], &t.buffers[ACTIONS]) &&
        (count <= GIVEN_ARRAYS || take_judged(self, playing, args + GIVEN_ARRAYS, &t)) &&
        (count <= GIVEN_STARTS ||
         take_starts_of_step(self, playing, args[GIVEN_STARTS], &t))) {
        settle_turn(self, playing, &t);
        if (play_turn(self, operation, &t)) {
            result = count > GIVEN_ARRAYS ? told_of(&t) : Py_NewRef(Py_None);
        }
    }
    release_turn(playing, &t);
    return result;
}

/* Keeps what was prepared alive while it plays. */
static PyObject *play_by(PyObject *object, int operation, PyObject *const *args,
                         Py_ssize_t count) {
    PyPool *self = (PyPool *)object;

    if (!is_prepared(self)) {
        return NULL;
    }
    PyObject *playing = Py_NewRef(self->playing);
    PyObject *result = play_with(self, operation, playing_of(playing), args, count);
    Py_DECREF(playing);
    return result;
}

PyObject *py_play(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    return has_arguments(nargs, GIVEN) ? play_by(object, PLAY, args, nargs) : NULL;
}

PyObject *py_play_before(PyObject *object, PyObject *actions) {
    return play_by(object, BEFORE, &actions, 1);
}

PyObject *py_play_after(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    return has_arguments(nargs, GIVEN_STARTS) ? play_by(object, AFTER, args, nargs) : NULL;
}

/* Nothing but the check of the actions that every step begins with. */
PyObject *py_check_actions(PyObject *object, PyObject *actions) {
    PyPool *self = (PyPool *)object;
    PyTurn t;

    if (!is_prepared(self)) {
        return NULL;
    }
    PyObject *capsule = Py_NewRef(self->playing);
    const Playing *playing = playing_of(capsule);
    clear_turn(playing, &t);
    bool good = take_array_of_actions(playing, actions, &t.buffers[ACTIONS]);
    if (good) {
        settle_turn(self, playing, &t);
        good = !play_has_bad_action(&t.turn, 1);
        if (!good) {
            raise_bad_action();
        }
    }
    release_turn(playing, &t);
    Py_DECREF(capsule);
    return good ? Py_NewRef(Py_None) : NULL;
}
