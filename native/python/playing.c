/* Preparing a pool to play: see play.h. */

#include "playing.h"

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
    for (size_t i = 0; i < playing->number_of_row_buffers; i++) {
        release_buffer(&playing->row_buffers[i]);
    }
    free(playing->row_buffers);
    free(playing->copies);
    free(playing->variable_starts);
    free(playing->drawn_variables);
    free(playing->input_starts);
    release_program(&playing->inputs);
    release_program(&playing->judgement);
    Py_XDECREF(playing->start);
    Py_XDECREF(playing->draws);
    results_free(playing->results);
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

/* Parses the values of a dict by name, as PyArg_ParseTupleAndKeywords does. */
static bool parse_group(PyObject *group, const char *format, char **names, ...) {
    PyObject *nothing = PyTuple_New(0);
    va_list places;

    va_start(places, names);
    const bool parsed =
        nothing != NULL && PyArg_VaParseTupleAndKeywords(nothing, group, format, names, places);
    va_end(places);
    Py_XDECREF(nothing);
    return parsed;
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

/* Returns the number of elements of an action, or -1 with an exception. */
static Py_ssize_t take_action_shape(PyPool *self, Playing *playing, PyObject *shape) {
    const Py_ssize_t dimensions = PyTuple_Size(shape);
    Py_ssize_t elements = 1;

    playing->action_dimensions = 1 + (int)dimensions;
    playing->action_shape[0] = (Py_ssize_t)self->pool.settings.count;
    for (Py_ssize_t i = 0; i < dimensions && i < MOST_DIMENSIONS; i++) {
        const Py_ssize_t length = PyLong_AsSsize_t(PyTuple_GetItem(shape, i));
        if (length < 0 || length > UINT16_MAX) {
            elements = -1;
            break;
        }
        playing->action_shape[1 + i] = length;
        elements *= length;
    }
    if (elements < 0 || elements > UINT16_MAX || dimensions > MOST_DIMENSIONS) {
        PyErr_SetString(PyExc_ValueError, "an action has too many elements");
        return -1;
    }
    return elements;
}

/* Actions that are kept need memory for this step and for the one before. */
static bool take_actions(PyPool *self, Playing *playing, PyObject *group) {
    static char *names[] = {"shape",   "letter",  "size",     "check", "lowest",
                            "highest", "current", "previous", "none",  NULL};
    Actions *a = &playing->play.actions;
    Py_buffer *b = playing->buffers;
    PyObject *shape, *current, *previous, *none;
    Py_ssize_t size;
    long long lowest, highest;
    int check;

    if (!parse_group(group, "$O!CniLLOOO:actions", names, &PyTuple_Type, &shape,
                     &playing->action_letter, &size, &check, &lowest, &highest, &current, &previous,
                     &none)) {
        return false;
    }
    const Py_ssize_t elements = take_action_shape(self, playing, shape);
    if (elements < 0) {
        return false;
    }
    const Py_ssize_t length = elements * (Py_ssize_t)self->pool.settings.count;
    *a = (Actions){.elements = (size_t)elements,
                   .size = (size_t)size,
                   .check = (ActionCheck)check,
                   .lowest = lowest,
                   .highest = highest};
    if (!take_numbers(none, &b[NO_ACTION], false, "no action", elements) ||
        (current != Py_None &&
         (!take_numbers(current, &b[CURRENT], true, "current actions", length) ||
          !take_numbers(previous, &b[PREVIOUS], true, "previous actions", length)))) {
        return false;
    }
    a->current = b[CURRENT].buf;
    a->previous = b[PREVIOUS].buf;
    a->none = b[NO_ACTION].buf;
    if (b[NO_ACTION].itemsize != size ||
        (a->current != NULL && (b[CURRENT].itemsize != size || b[PREVIOUS].itemsize != size))) {
        PyErr_SetString(PyExc_ValueError, "actions differ in type");
        return false;
    }
    return true;
}

static bool take_kept(PyPool *self, Playing *playing, PyObject *kept) {
    const Settings *s = &self->pool.settings;

    return take_matrix(kept, &playing->buffers[KEPT], WRITTEN, "kept", ITEM_FLOAT64,
                       (Py_ssize_t)s->outputs->count, (Py_ssize_t)s->count);
}

/* None stands for steps of which nobody asks for this later. */
static bool take_done(PyPool *self, Playing *playing, PyObject *done) {
    return done == Py_None || take_vector(done, &playing->buffers[DONE], WRITTEN, "done",
                                          ITEM_BOOLEAN, (Py_ssize_t)self->pool.settings.count);
}

/* Takes a row that the pool writes. There is room for its buffer. */
static bool take_row(PyPool *self, Playing *playing, PyObject *object, Row *row) {
    Py_buffer *buffer = &playing->row_buffers[playing->number_of_row_buffers++];

    if (!take_numbers(object, buffer, true, "an episode variable",
                      (Py_ssize_t)self->pool.settings.count)) {
        return false;
    }
    *row = (Row){.data = buffer->buf, .size = (size_t)buffer->itemsize};
    return true;
}

static bool take_copy(PyPool *self, Playing *playing, PyObject *pair, RowCopy *copy) {
    PyObject *source, *target;

    if (!PyArg_ParseTuple(pair, "OO;a copy is a row and the row to copy it to", &source, &target) ||
        !take_row(self, playing, source, &copy->from) ||
        !take_row(self, playing, target, &copy->to)) {
        return false;
    }
    if (copy->from.size != copy->to.size) {
        PyErr_SetString(PyExc_ValueError, "rows to copy differ in type");
        return false;
    }
    return true;
}

static bool take_variable_start(PyPool *self, Playing *playing, PyObject *pair,
                                VariableStart *start) {
    PyObject *row;
    const char *bytes;
    Py_ssize_t size;

    if (!PyArg_ParseTuple(pair, "Oy#;a variable and its start", &row, &bytes, &size) ||
        !take_row(self, playing, row, &start->row)) {
        return false;
    }
    if ((size_t)size != start->row.size) {
        PyErr_SetString(PyExc_ValueError, "a variable and its start differ in type");
        return false;
    }
    memcpy(&start->bits, bytes, (size_t)size);
    return true;
}

static bool take_drawn_variable(PyPool *self, Playing *playing, PyObject *pair,
                                DrawnVariable *variable) {
    PyObject *row;
    Py_ssize_t draw;

    if (!PyArg_ParseTuple(pair, "On;a variable and its draw", &row, &draw) ||
        !take_row(self, playing, row, &variable->row)) {
        return false;
    }
    variable->draw = (size_t)draw;
    if (variable->row.size != sizeof(double) || variable->draw >= playing->play.draws->count) {
        PyErr_SetString(PyExc_ValueError, "a drawn variable is no float64, or has no draw");
        return false;
    }
    return true;
}

static bool take_variables(PyPool *self, Playing *playing, PyObject *copies, PyObject *starts,
                           PyObject *drawn) {
    const size_t a = (size_t)PyTuple_Size(copies), b = (size_t)PyTuple_Size(starts),
                 c = (size_t)PyTuple_Size(drawn);
    Play *play = &playing->play;
    bool good = true;

    playing->row_buffers = calloc(2 * a + b + c + 1, sizeof *playing->row_buffers);
    play->copies = playing->copies = calloc(a + 1, sizeof *playing->copies);
    play->variable_starts = playing->variable_starts =
        calloc(b + 1, sizeof *playing->variable_starts);
    play->drawn_variables = playing->drawn_variables =
        calloc(c + 1, sizeof *playing->drawn_variables);
    if (playing->row_buffers == NULL || playing->copies == NULL ||
        playing->variable_starts == NULL || playing->drawn_variables == NULL) {
        PyErr_NoMemory();
        return false;
    }
    play->number_of_copies = a;
    play->number_of_variable_starts = b;
    play->number_of_drawn_variables = c;
    for (size_t i = 0; i < a && good; i++) {
        good = take_copy(self, playing, PyTuple_GetItem(copies, (Py_ssize_t)i),
                         &playing->copies[i]);
    }
    for (size_t i = 0; i < b && good; i++) {
        good = take_variable_start(self, playing, PyTuple_GetItem(starts, (Py_ssize_t)i),
                                   &playing->variable_starts[i]);
    }
    for (size_t i = 0; i < c && good; i++) {
        good = take_drawn_variable(self, playing, PyTuple_GetItem(drawn, (Py_ssize_t)i),
                                   &playing->drawn_variables[i]);
    }
    return good;
}

/* Each input starts with the value of a parameter or, if its number is negative, a constant. */
static bool take_input_starts(PyPool *self, Playing *playing, PyObject *starts) {
    const Py_ssize_t count = PyTuple_Size(starts);
    const Py_ssize_t parameters = (Py_ssize_t)((PyAccess *)playing->start)->access.count;
    const double *values = playing->buffers[STARTS].buf;

    playing->input_starts = calloc((size_t)count + 1, sizeof *playing->input_starts);
    if (playing->input_starts == NULL) {
        PyErr_NoMemory();
        return false;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        InputStart *start = &playing->input_starts[i];
        Py_ssize_t number;
        if (!PyArg_ParseTuple(PyTuple_GetItem(starts, i), "nd;an input's start", &number,
                              &start->value)) {
            return false;
        }
        if (number >= 0 && number < parameters) {
            start->row = values + number * (Py_ssize_t)self->pool.settings.count;
        }
    }
    playing->play.input_starts = playing->input_starts;
    playing->play.number_of_inputs = (size_t)count;
    return true;
}

static void settle_play(PyPool *self, Playing *playing) {
    const Py_buffer *b = playing->buffers;
    const Settings *s = &self->pool.settings;
    Play *play = &playing->play;

    program_note_outputs(&playing->judgement.form, s->output_values, s->outputs->count, s->count);
    play->count = s->count;
    play->inputs = playing->inputs.form.program;
    play->judgement = playing->judgement.form.program;
    play->input_rows = self->buffers[INPUTS].buf;
    play->output_rows = s->output_values;
    play->kept_rows = b[KEPT].buf;
    play->number_of_outputs = s->outputs->count;
    play->start_values = b[STARTS].buf;
    play->number_of_parameters = ((PyAccess *)playing->start)->access.count;
    play->streams = b[STATES].buf;
    play->step_counts = b[COUNTS].buf;
    play->ended = b[ENDED].buf;
    play->done = b[DONE].buf;
    play->source.statuses = s->status;
}

static bool is_sound(const PyPool *self, const Play *play) {
    const bool sound = play->inputs.number_of_seen == 0 &&
                 play->judgement.number_of_results == PROGRAM_RESULTS &&
                 play->number_of_inputs == self->pool.settings.inputs->count &&
                 draws_fit(play->draws, play->number_of_parameters);

    if (!sound) {
        PyErr_SetString(PyExc_ValueError, "a program does not fit the pool");
    }
    return sound;
}

/* The arguments of prepare_play. */
typedef struct {
    PyObject *start, *start_values, *inputs, *judgement, *actions, *draws, *states, *episodes;
    PyObject *kept, *done, *copies, *variable_starts, *drawn_variables, *input_starts, *results;
    int reads_kept;
} Parts;

static bool parse(PyObject *args, PyObject *kwargs, Parts *p) {
    static char *names[] = {"start",         "start_values", "inputs",
                            "judgement",     "actions",      "draws",
                            "states",        "episodes",     "kept",
                            "done",          "reads_kept",   "copies",       "variable_starts",
                            "drawn_variables", "input_starts", "results", NULL};

    return PyArg_ParseTupleAndKeywords(
        args, kwargs, "$OOO!O!O!OOO!OOpO!O!O!O!O:prepare_play", names, &p->start, &p->start_values,
        &PyTuple_Type, &p->inputs, &PyTuple_Type, &p->judgement, &PyDict_Type, &p->actions,
        &p->draws, &p->states, &PyDict_Type, &p->episodes, &p->kept, &p->done, &p->reads_kept,
        &PyTuple_Type, &p->copies, &PyTuple_Type, &p->variable_starts, &PyTuple_Type,
        &p->drawn_variables, &PyTuple_Type, &p->input_starts, &p->results);
}

static bool take_programs(PyPool *self, Playing *playing, const Parts *p) {
    const Py_ssize_t n = (Py_ssize_t)self->pool.settings.count;
    const size_t elements = playing->play.actions.elements;

    return take_program(p->inputs, n, elements, &playing->inputs) &&
           take_program(p->judgement, n, elements, &playing->judgement);
}

bool pool_observes(const Playing *playing) {
    return playing->judgement.form.program.number_of_seen == 0 && playing->results != NULL &&
           results_number_of_seen(playing->results) == 1;
}

static bool results_fit(const PyPool *self, const Playing *playing) {
    const Settings *s = &self->pool.settings;
    const Results *r = playing->results;
    const size_t seen = playing->judgement.form.program.number_of_seen;
    bool fit = results_size(r, REWARDS_ARRAY) == s->count * sizeof(double) &&
               results_size(r, TERMINATED_ARRAY) == s->count &&
               results_size(r, TRUNCATED_ARRAY) == s->count &&
               results_size(r, MASK_ARRAY) == s->count &&
               results_size(r, DRAWN_ARRAY) ==
                   playing->play.draws->count * s->count * sizeof(double);

    if (pool_observes(playing)) {
        return fit && results_size(r, 0) == s->count * s->num_observed * sizeof(float);
    }
    for (size_t i = 0; i < seen && fit; i++) {
        fit = results_size(r, i) == (size_t)playing->judgement.seen_bytes[i];
    }
    return fit && results_number_of_seen(r) == seen;
}

static bool take_results(PyPool *self, Playing *playing, PyObject *parts) {
    if (parts == Py_None) {
        return true;
    }
    playing->results = results_take(parts);
    if (playing->results != NULL && !results_fit(self, playing)) {
        PyErr_SetString(PyExc_ValueError, "the arrays of results do not fit the pool");
        return false;
    }
    return playing->results != NULL;
}

/* What comes later refers to what comes first. */
static bool take_parts(PyPool *self, Playing *playing, const Parts *p) {
    playing->play.reads_kept = p->reads_kept != 0;
    return take_starts(self, playing, p->start, p->start_values) &&
           take_actions(self, playing, p->actions) && take_programs(self, playing, p) &&
           take_draws(self, playing, p->draws, p->states) &&
           take_episodes(self, playing, p->episodes) && take_kept(self, playing, p->kept) &&
           take_done(self, playing, p->done) &&
           take_variables(self, playing, p->copies, p->variable_starts, p->drawn_variables) &&
           take_input_starts(self, playing, p->input_starts) &&
           take_results(self, playing, p->results);
}

static bool fill(PyPool *self, Playing *playing, PyObject *args, PyObject *kwargs) {
    Parts parts;

    if (!parse(args, kwargs, &parts) || !take_parts(self, playing, &parts)) {
        return false;
    }
    settle_play(self, playing);
    return is_sound(self, &playing->play);
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
