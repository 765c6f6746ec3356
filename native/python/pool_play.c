/* The methods of the type Pool for playing: see play.h. */

#include <stdlib.h>
#include <string.h>

#include "python.h"

enum { STARTS, STATES, COUNTS, ENDED, PLAY_BUFFERS };

static const char *const PLAYING = "fmugym._native.playing";

/* The result of prepare_play. It never changes; the next call replaces it as a whole. */
typedef struct {
    Play play;
    Py_buffer buffers[PLAY_BUFFERS];
    PyObject *start; /* the Access of the variables set before initialization */
    PyObject *draws;
} Playing;

static void playing_free(Playing *playing) {
    for (int i = 0; i < PLAY_BUFFERS; i++) {
        release_buffer(&playing->buffers[i]);
    }
    Py_XDECREF(playing->start);
    Py_XDECREF(playing->draws);
    free(playing);
}

static void playing_dealloc(PyObject *capsule) {
    playing_free(PyCapsule_GetPointer(capsule, PLAYING));
}

static void replace_reference(PyObject **place, PyObject *object) {
    PyObject *before = *place;

    *place = object;
    Py_XDECREF(before);
}

/* Preparing */

/* Copies a part of a program. Returns its length, or -1 with an exception if it does not fit. */
static Py_ssize_t take_part(const char *name, Py_buffer *bytes, size_t size, size_t most,
                            void *place) {
    const size_t length = (size_t)bytes->len / size;
    const bool fits = (size_t)bytes->len % size == 0 && length <= most;

    if (fits) {
        memcpy(place, bytes->buf, (size_t)bytes->len);
    } else {
        PyErr_Format(PyExc_ValueError,
                     "the %s of a program must be at most %zu times %zu bytes, not %zd", name, most,
                     size, bytes->len);
    }
    PyBuffer_Release(bytes);
    return fits ? (Py_ssize_t)length : -1;
}

static bool take_program(PyObject *parts, Program *program) {
    Py_buffer code, constants, results;

    if (!PyArg_ParseTuple(parts, "y*y*y*;a program is its code, constants and results", &code,
                          &constants, &results)) {
        return false;
    }
    const Py_ssize_t lengths[] = {
        take_part("code", &code, sizeof(Instruction), PROGRAM_LENGTH, program->code),
        take_part("constants", &constants, sizeof(double), PROGRAM_LENGTH, program->constants),
        take_part("results", &results, sizeof(uint16_t), PROGRAM_RESULTS, program->results),
    };
    program->length = (size_t)lengths[0];
    program->number_of_constants = (size_t)lengths[1];
    program->number_of_results = (size_t)lengths[2];
    return lengths[0] >= 0 && lengths[1] >= 0 && lengths[2] >= 0;
}

static bool take_starts(PyPool *self, Playing *playing, PyObject *start, PyObject *values) {
    if (!is_access(self, start)) {
        return false;
    }
    Py_INCREF(start);
    playing->start = start;
    return take_matrix(values, &playing->buffers[STARTS], WRITTEN, "start_values", ITEM_FLOAT64,
                       (Py_ssize_t)((PyAccess *)start)->access.count,
                       (Py_ssize_t)self->pool.settings.count);
}

static bool take_draws(PyPool *self, Playing *playing, PyObject *draws, PyObject *states) {
    const Py_ssize_t n = (Py_ssize_t)self->pool.settings.count;

    if (!PyObject_TypeCheck(draws, draws_type)) {
        PyErr_SetString(PyExc_TypeError, "expected Draws");
        return false;
    }
    playing->draws = Py_NewRef(draws);
    playing->play.draws = &((PyDraws *)draws)->draws;
    return take_matrix(states, &playing->buffers[STATES], WRITTEN, "states", ITEM_UINT64, n,
                       STREAM_NUMBERS);
}

static bool take_episodes(PyPool *self, Playing *playing, PyObject *group) {
    static char *names[] = {"step_counts", "ended", "limit", NULL};
    const Py_ssize_t n = (Py_ssize_t)self->pool.settings.count;
    Py_buffer *b = playing->buffers;
    PyObject *step_counts, *ended;
    long long limit;

    if (!parse_group(group, "$OOL:episodes", names, &step_counts, &ended, &limit)) {
        return false;
    }
    playing->play.limit = limit;
    return take_vector(step_counts, &b[COUNTS], WRITTEN, "step_counts", ITEM_INT64, n) &&
           take_vector(ended, &b[ENDED], WRITTEN, "ended", ITEM_BOOLEAN, n);
}

static void settle_play(PyPool *self, Playing *playing) {
    const Py_buffer *b = playing->buffers;
    const Settings *s = &self->pool.settings;
    Play *play = &playing->play;

    play->count = s->count;
    play->input_rows = self->buffers[INPUTS].buf;
    play->start_values = b[STARTS].buf;
    play->streams = b[STATES].buf;
    play->step_counts = b[COUNTS].buf;
    play->ended = b[ENDED].buf;
    play->source = (Source){
        .outputs = s->output_values,
        .inputs = play->input_rows,
        .parameters = play->start_values,
        .step_counts = play->step_counts,
        .count = s->count,
        .number_of_outputs = s->outputs->count,
        .number_of_inputs = s->inputs->count,
        .number_of_parameters = ((PyAccess *)playing->start)->access.count,
    };
}

static bool is_sound(const Play *play) {
    const bool sound =
        play->judgement.length > 0 && program_is_sound(&play->inputs, &play->source) &&
                 program_is_sound(&play->judgement, &play->source) &&
                 play->inputs.number_of_results == play->source.number_of_inputs &&
                 play->judgement.number_of_results == 3 &&
        draws_fit(play->draws, play->source.number_of_parameters);

    if (!sound) {
        PyErr_SetString(PyExc_ValueError, "a program does not fit the pool");
    }
    return sound;
}

static bool fill(PyPool *self, Playing *playing, PyObject *args, PyObject *kwargs) {
    static char *names[] = {"start",   "start_values", "inputs",   "judgement",
                            "actions", "draws",        "states", "episodes", NULL};
    PyObject *start, *values, *inputs, *judgement, *draws, *states, *episodes;
    long long lowest, highest;

    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "$OOO!O!(LL)OOO!:prepare_play", names, &start,
                                     &values, &PyTuple_Type, &inputs, &PyTuple_Type, &judgement,
                                     &lowest, &highest, &draws, &states, &PyDict_Type, &episodes)) {
        return false;
    }
    playing->play.lowest_action = lowest;
    playing->play.highest_action = highest;
    if (!take_starts(self, playing, start, values) ||
        !take_program(inputs, &playing->play.inputs) ||
        !take_program(judgement, &playing->play.judgement) || !take_draws(self, playing, draws, states) ||
        !take_episodes(self, playing, episodes)) {
        return false;
    }
    settle_play(self, playing);
    return is_sound(&playing->play);
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

/* Playing */

enum { ACTIONS, SEEN, REWARDS, TERMINATED, TRUNCATED, DRAWN, TURN_BUFFERS };

typedef struct {
    Py_buffer buffers[TURN_BUFFERS];
    Turn turn;
    Call call;
    bool bad_action;
    size_t troubled, ended;
} PyTurn;

static bool take_arrays(PyPool *self, const Play *play, PyObject *const *args, PyTurn *t) {
    const Settings *s = &self->pool.settings;
    const Py_ssize_t n = (Py_ssize_t)s->count;
    Py_buffer *b = t->buffers;

    return take_vector(args[ACTIONS], &b[ACTIONS], IN_PLACE, "actions", ITEM_INT64, n) &&
           take_matrix(args[SEEN], &b[SEEN], WRITTEN, "observations", ITEM_FLOAT32, n,
                       (Py_ssize_t)s->num_observed) &&
           take_vector(args[REWARDS], &b[REWARDS], WRITTEN, "rewards", ITEM_FLOAT64, n) &&
           take_vector(args[TERMINATED], &b[TERMINATED], WRITTEN, "terminated", ITEM_BOOLEAN, n) &&
           take_vector(args[TRUNCATED], &b[TRUNCATED], WRITTEN, "truncated", ITEM_BOOLEAN, n) &&
           take_matrix(args[DRAWN], &b[DRAWN], WRITTEN, "drawn", ITEM_FLOAT64,
                       (Py_ssize_t)play->draws->count, n);
}

static void settle_turn(PyPool *self, const Playing *playing, PyTurn *t) {
    const Py_buffer *b = t->buffers;
    const Py_buffer *inputs = &self->buffers[INPUTS], *starts = &playing->buffers[STARTS];

    t->turn = (Turn){
        .play = &playing->play,
        .actions = b[ACTIONS].buf,
        .rewards = b[REWARDS].buf,
        .terminated = b[TERMINATED].buf,
        .truncated = b[TRUNCATED].buf,
        .drawn = b[DRAWN].buf,
    };
    t->call = (Call){
        .inputs = {inputs->buf, inputs->strides[0], inputs->strides[1]},
        .start = &((PyAccess *)playing->start)->access,
        .start_values = {starts->buf, starts->strides[0], starts->strides[1]},
        .mask = {(const char *)playing->play.ended, 1},
        .observations = b[SEEN].buf,
        .turn = &t->turn,
    };
}

static void do_play(PyPool *self, bool alone, void *context) {
    PyTurn *t = context;

    t->call.alone = alone;
    t->bad_action = play_has_bad_action(&t->turn);
    if (!t->bad_action) {
        t->troubled = pool_play(&self->pool, &t->call, &t->ended);
    }
}

static PyObject *play_turn(PyPool *self, PyTurn *t) {
    if (!perform(self, PLAY, do_play, t)) {
        return NULL;
    }
    if (t->bad_action) {
        PyErr_SetString(PyExc_ValueError, "an action is out of range");
        return NULL;
    }
    return report_messages(self)
               ? Py_BuildValue("(nn)", (Py_ssize_t)t->troubled, (Py_ssize_t)t->ended)
               : NULL;
}

static PyObject *play_with(PyPool *self, PyObject *capsule, PyObject *const *args) {
    const Playing *playing = PyCapsule_GetPointer(capsule, PLAYING);
    PyTurn t = {.bad_action = false};
    PyObject *result = NULL;

    if (take_arrays(self, &playing->play, args, &t)) {
        settle_turn(self, playing, &t);
        result = play_turn(self, &t);
    }
    for (int i = 0; i < TURN_BUFFERS; i++) {
        release_buffer(&t.buffers[i]);
    }
    return result;
}

PyObject *py_play(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;

    if (!has_arguments(nargs, TURN_BUFFERS)) {
        return NULL;
    }
    if (self->playing == NULL) {
        PyErr_SetString(PyExc_ValueError, "play was not prepared");
        return NULL;
    }
    PyObject *playing = Py_NewRef(self->playing);
    PyObject *result = play_with(self, playing, args);
    Py_DECREF(playing);
    return result;
}
