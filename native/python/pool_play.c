/* The methods of the type Pool for playing: see play.h. */

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "programs.h"
#include "results.h"

enum {
    STARTS,
    STATES,
    COUNTS,
    ENDED,
    CURRENT,
    PREVIOUS,
    NO_ACTION,
    KEPT,
    PLAY_BUFFERS
};

static const char *const PLAYING = "fmugym._native.playing";

enum { MOST_DIMENSIONS = 8 };

/* The result of prepare_play. It never changes; the next call replaces it as a whole. */
typedef struct {
    Play play;
    PyProgram inputs, judgement;
    Py_buffer buffers[PLAY_BUFFERS];
    Py_buffer *row_buffers; /* two for each copy, one for each variable and variable's start */
    size_t number_of_row_buffers;
    RowCopy *copies;
    VariableStart *variable_starts;
    DrawnVariable *drawn_variables;
    InputStart *input_starts;
    int action_letter, action_dimensions;
    Py_ssize_t action_shape[MOST_DIMENSIONS + 1]; /* with the environments on the first axis */
    PyObject *start; /* the Access of the variables set before initialization */
    PyObject *draws;
    Results *results; /* NULL if only rollouts follow */
} Playing;

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
    playing_free(PyCapsule_GetPointer(capsule, PLAYING));
}

static void replace_reference(PyObject **place, PyObject *object) {
    PyObject *before = *place;

    *place = object;
    Py_XDECREF(before);
}

/* Preparing */

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

/* Notes which rows are those of the outputs, as long as the program only reads them. */
static void note_outputs(const Settings *s, PyProgram *p) {
    for (size_t i = 0; i < p->program.number_of_rows; i++) {
        Row *row = &p->rows[i];
        for (uint32_t k = 0; k < s->outputs->count && !row->changes; k++) {
            if (row->data == (char *)(s->output_values + k * s->count)) {
                row->output = k + 1;
            }
        }
    }
}

static void settle_play(PyPool *self, Playing *playing) {
    const Py_buffer *b = playing->buffers;
    const Settings *s = &self->pool.settings;
    Play *play = &playing->play;

    note_outputs(s, &playing->judgement);
    play->count = s->count;
    play->inputs = playing->inputs.program;
    play->judgement = playing->judgement.program;
    play->input_rows = self->buffers[INPUTS].buf;
    play->output_rows = s->output_values;
    play->kept_rows = b[KEPT].buf;
    play->number_of_outputs = s->outputs->count;
    play->start_values = b[STARTS].buf;
    play->number_of_parameters = ((PyAccess *)playing->start)->access.count;
    play->streams = b[STATES].buf;
    play->step_counts = b[COUNTS].buf;
    play->ended = b[ENDED].buf;
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
    PyObject *kept, *copies, *variable_starts, *drawn_variables, *input_starts, *results;
    int reads_kept;
} Parts;

static bool parse(PyObject *args, PyObject *kwargs, Parts *p) {
    static char *names[] = {"start",         "start_values", "inputs",
                            "judgement",     "actions",      "draws",
                            "states",        "episodes",     "kept",
                            "reads_kept",  "copies",       "variable_starts",
                            "drawn_variables", "input_starts", "results", NULL};

    return PyArg_ParseTupleAndKeywords(
        args, kwargs, "$OOO!O!O!OOO!OpO!O!O!O!O:prepare_play", names, &p->start, &p->start_values,
        &PyTuple_Type, &p->inputs, &PyTuple_Type, &p->judgement, &PyDict_Type, &p->actions,
        &p->draws, &p->states, &PyDict_Type, &p->episodes, &p->kept, &p->reads_kept,
        &PyTuple_Type, &p->copies, &PyTuple_Type, &p->variable_starts, &PyTuple_Type,
        &p->drawn_variables, &PyTuple_Type, &p->input_starts, &p->results);
}

static bool take_programs(PyPool *self, Playing *playing, const Parts *p) {
    const Py_ssize_t n = (Py_ssize_t)self->pool.settings.count;
    const size_t elements = playing->play.actions.elements;

    return take_program(p->inputs, n, elements, &playing->inputs) &&
           take_program(p->judgement, n, elements, &playing->judgement);
}

/* Whether the pool itself fills the observations, instead of the program. */
static bool pool_observes(const Playing *playing) {
    return playing->judgement.program.number_of_seen == 0 && playing->results != NULL &&
           results_number_of_seen(playing->results) == 1;
}

static bool results_fit(const PyPool *self, const Playing *playing) {
    const Settings *s = &self->pool.settings;
    const Results *r = playing->results;
    const size_t seen = playing->judgement.program.number_of_seen;
    bool fit = results_size(r, REWARDS_ARRAY) == s->count * sizeof(double) &&
               results_size(r, TERMINATED_ARRAY) == s->count &&
               results_size(r, TRUNCATED_ARRAY) == s->count;

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
    PyCapsule_SetContext(capsule, self); /* other pools have other arrays */
    replace_reference(&self->playing, capsule);
    Py_RETURN_NONE;
}

/* Puts what was prepared before in the place of what is prepared now, and returns that. */
PyObject *py_exchange_play(PyObject *object, PyObject *other) {
    PyPool *self = (PyPool *)object;
    PyObject *present = Py_NewRef(self->playing == NULL ? Py_None : self->playing);

    if (other != Py_None &&
        (!PyCapsule_IsValid(other, PLAYING) || PyCapsule_GetContext(other) != self)) {
        Py_DECREF(present);
        PyErr_SetString(PyExc_TypeError, "expected what exchange_play has returned");
        return NULL;
    }
    replace_reference(&self->playing, other == Py_None ? NULL : Py_NewRef(other));
    return present;
}

/* Playing */

enum {
    ACTIONS,
    SEEN,
    REWARDS,
    TERMINATED,
    TRUNCATED,
    DRAWN,
    LAST,
    STARTED,
    MASK,
    TURN_BUFFERS
};

enum { STEP_ACTIONS, STEP_DRAWN, STEP_LAST, STEP_STARTED, STEP_ARGUMENTS };

typedef struct {
    Py_buffer buffers[TURN_BUFFERS];
    Py_buffer seen_buffers[MOST_SEEN], last_buffers[MOST_SEEN];
    char *seen[MOST_SEEN], *last_seen[MOST_SEEN];
    size_t seen_sizes[MOST_SEEN];
    Turn turn;
    Call call;
    bool bad_action;
    size_t troubled;
    Ends ends;
} PyTurn;

/* None stands for episodes that start in the step after the end of the previous one. */
static bool take_starts_at_ends(PyPool *self, const Playing *playing, PyObject *last,
                                PyObject *started, PyTurn *t) {
    const Settings *s = &self->pool.settings;
    const Py_ssize_t n = (Py_ssize_t)s->count;

    if (last == Py_None) {
        return true;
    }
    for (size_t i = 0; i < playing->judgement.program.number_of_seen; i++) {
        t->seen_sizes[i] = (size_t)(playing->judgement.seen_bytes[i] / n);
    }
    return (pool_observes(playing)
                ? take_matrix(last, &t->buffers[LAST], WRITTEN, "the last observations",
                              ITEM_FLOAT32, n, (Py_ssize_t)s->num_observed)
                : take_seen(&playing->judgement, last, t->last_buffers, t->last_seen)) &&
           take_vector(started, &t->buffers[STARTED], WRITTEN, "started", ITEM_BOOLEAN, n);
}

/* Takes memory that must have so many bytes, whatever its items are: that of arrays that the caller
 * has just made. To tell their types, numpy would describe them in text, which takes as long as all
 * other checks together. */
static bool take_bytes(PyObject *object, Py_buffer *buffer, int flags, size_t size) {
    if (PyObject_GetBuffer(object, buffer, PyBUF_C_CONTIGUOUS | flags) < 0) {
        return false;
    }
    if ((size_t)buffer->len != size) {
        PyErr_Format(PyExc_ValueError, "an array has %zd bytes, expected %zu", buffer->len, size);
    }
    return (size_t)buffer->len == size;
}

/* The observations are one array that the pool fills itself, or those that the program stores. */
static bool take_observations(PyPool *self, const Playing *playing, PyObject *seen, PyTurn *t) {
    const Settings *s = &self->pool.settings;

    if (playing->judgement.program.number_of_seen > 0 || PyTuple_Check(seen)) {
        return take_seen(&playing->judgement, seen, t->seen_buffers, t->seen);
    }
    return take_bytes(seen, &t->buffers[SEEN], PyBUF_WRITABLE,
                      s->count * s->num_observed * sizeof(float));
}

/* Whether the items of a buffer are of the kind that a letter stands for: d for floats, q for
 * integers, Q for those without sign, ? for Booleans. */
static bool has_letter(const Py_buffer *buffer, int letter) {
    const char *format = buffer->format == NULL ? "B" : buffer->format;
    const char *const letters = letter == 'd'   ? "fde"
                                : letter == 'q' ? "bhilq"
                                : letter == 'Q' ? "BHILQ"
                                                : "?";

    if (*format == '@' || *format == '=') {
        format++;
    }
    return format[0] != '\0' && format[1] == '\0' && strchr(letters, format[0]) != NULL;
}

/* Actions of another type or shape come back as an exception; the caller then converts them. */
static bool take_given_actions(const Playing *playing, PyObject *actions, PyTurn *t) {
    Py_buffer *b = &t->buffers[ACTIONS];

    if (PyObject_GetBuffer(actions, b, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        return false;
    }
    bool fits = b->ndim == playing->action_dimensions && has_letter(b, playing->action_letter) &&
                b->itemsize == (Py_ssize_t)playing->play.actions.size;
    for (int i = 0; fits && i < b->ndim; i++) {
        fits = b->shape[i] == playing->action_shape[i];
    }
    if (!fits || (uintptr_t)b->buf % (uintptr_t)b->itemsize != 0) {
        PyErr_SetString(PyExc_TypeError, "the actions have another type or shape");
        return false;
    }
    return true;
}

static bool take_arrays(PyPool *self, const Playing *playing, PyObject *const *args, PyTurn *t) {
    return take_given_actions(playing, args[STEP_ACTIONS], t) &&
           take_bytes(args[STEP_DRAWN], &t->buffers[DRAWN], PyBUF_WRITABLE,
                      playing->play.draws->count * self->pool.settings.count * sizeof(double)) &&
           take_starts_at_ends(self, playing, args[STEP_LAST], args[STEP_STARTED], t);
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
        .seen = t->seen,
        .drawn = b[DRAWN].buf,
        .last_observations = b[LAST].buf,
        .last_seen = t->last_seen,
        .seen_sizes = t->seen_sizes,
        .started = b[STARTED].buf,
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

static bool is_outside(const PyTurn *t) {
    if (t->ends.outside) {
        PyErr_SetString(PyExc_IndexError, "a hook looks up an index outside of its table");
    }
    return t->ends.outside;
}

/* Lets the step fill the arrays that it returns. */
static void settle_results(const Playing *playing, const StepArrays *arrays, PyTurn *t) {
    t->turn.rewards = (double *)(void *)arrays->memory[REWARDS_ARRAY];
    t->turn.terminated = (uint8_t *)arrays->memory[TERMINATED_ARRAY];
    t->turn.truncated = (uint8_t *)arrays->memory[TRUNCATED_ARRAY];
    t->turn.seen = arrays->memory;
    if (pool_observes(playing)) {
        t->call.observations = (float *)(void *)arrays->memory[0];
    }
}

/* The result, how many instances had trouble, how many episodes have ended, and how many of these
 * were followed. */
static PyObject *turn_result(const Playing *playing, const StepArrays *arrays, const PyTurn *t) {
    PyObject *tuple = PyTuple_New(4), *result = results_make(playing->results, arrays);

    if (tuple == NULL || result == NULL) {
        Py_XDECREF(tuple);
        Py_XDECREF(result);
        return NULL;
    }
    PyTuple_SetItem(tuple, 0, result);
    PyTuple_SetItem(tuple, 1, PyLong_FromSize_t(t->troubled));
    PyTuple_SetItem(tuple, 2, PyLong_FromSize_t(t->ends.ended));
    PyTuple_SetItem(tuple, 3, PyLong_FromSize_t(t->ends.started));
    return tuple;
}

static bool play_turn(PyPool *self, int operation, PyTurn *t) {
    static Work *const works[OPERATIONS] = {
        [PLAY] = do_play, [BEFORE] = do_before, [AFTER] = do_after};

    if (!perform(self, operation, works[operation], t)) {
        return false;
    }
    if (t->bad_action) {
        PyErr_SetString(PyExc_ValueError, "an action is out of range");
        return false;
    }
    return !is_outside(t) && report_messages(self);
}

/* Clears what is used of the many buffers. */
static void clear_turn(const Playing *playing, PyTurn *t) {
    const size_t size = playing->judgement.program.number_of_seen * sizeof(Py_buffer);

    t->bad_action = false;
    memset(t->buffers, 0, sizeof t->buffers);
    memset(t->seen_buffers, 0, size);
    memset(t->last_buffers, 0, size);
}

static void release_turn(const Playing *playing, PyTurn *t) {
    for (int i = 0; i < TURN_BUFFERS; i++) {
        release_buffer(&t->buffers[i]);
    }
    for (size_t i = 0; i < playing->judgement.program.number_of_seen; i++) {
        release_buffer(&t->seen_buffers[i]);
        release_buffer(&t->last_buffers[i]);
    }
}

/* What comes before the FMUs' part fills nothing that it returns. */
static PyObject *play_before_with(PyPool *self, PyObject *capsule, PyObject *const *args) {
    const Playing *playing = PyCapsule_GetPointer(capsule, PLAYING);
    PyTurn t;
    bool done = false;

    clear_turn(playing, &t);
    if (take_arrays(self, playing, args, &t)) {
        settle_turn(self, playing, &t);
        done = play_turn(self, BEFORE, &t);
    }
    release_turn(playing, &t);
    return done ? Py_NewRef(Py_None) : NULL;
}

static PyObject *play_with(PyPool *self, int operation, PyObject *capsule, PyObject *const *args) {
    const Playing *playing = PyCapsule_GetPointer(capsule, PLAYING);
    StepArrays arrays;
    PyTurn t;
    PyObject *result = NULL;

    clear_turn(playing, &t);
    if (results_provide(playing->results, &arrays) && take_arrays(self, playing, args, &t)) {
        settle_turn(self, playing, &t);
        settle_results(playing, &arrays, &t);
        result = play_turn(self, operation, &t) ? turn_result(playing, &arrays, &t) : NULL;
    }
    results_drop(playing->results, &arrays);
    release_turn(playing, &t);
    return result;
}

static bool is_prepared(const PyPool *self) {
    if (self->playing == NULL) {
        PyErr_SetString(PyExc_ValueError, "play was not prepared");
    }
    return self->playing != NULL;
}

static bool has_results(const PyPool *self) {
    const Playing *playing = PyCapsule_GetPointer(self->playing, PLAYING);

    if (playing->results == NULL) {
        PyErr_SetString(PyExc_ValueError, "play was prepared without results");
    }
    return playing->results != NULL;
}

static PyObject *play_by(PyObject *object, int operation, PyObject *const *args,
                         Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;

    if (!has_arguments(nargs, STEP_ARGUMENTS) || !is_prepared(self) || !has_results(self)) {
        return NULL;
    }
    PyObject *playing = Py_NewRef(self->playing);
    PyObject *result = operation == BEFORE ? play_before_with(self, playing, args)
                                           : play_with(self, operation, playing, args);
    Py_DECREF(playing);
    return result;
}

PyObject *py_play(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    return play_by(object, PLAY, args, nargs);
}

PyObject *py_play_before(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    return play_by(object, BEFORE, args, nargs);
}

PyObject *py_play_after(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    return play_by(object, AFTER, args, nargs);
}

/* Rollouts: each array has a row for each step. */

typedef struct {
    PyTurn turn;
    size_t horizon;
    Mask left_out;
} PyRollout;

static bool has_bad_action(const PyRollout *r) {
    const Play *play = r->turn.turn.play;
    const size_t size = play->count * play->actions.elements * play->actions.size;
    Turn turn = r->turn.turn;
    bool bad = false;

    for (size_t step = 0; step < r->horizon && !bad; step++, turn.actions += size) {
        bad = play_has_bad_action(&turn);
    }
    return bad;
}

static void do_rollout(PyPool *self, bool alone, void *context) {
    PyRollout *r = context;
    PyTurn *t = &r->turn;

    t->call.alone = alone;
    t->ends.outside = false;
    t->bad_action = has_bad_action(r);
    if (!t->bad_action) {
        t->troubled =
            pool_rollout(&self->pool, &t->call, r->horizon, r->left_out, &t->ends.outside);
    }
}

static bool take_rolled_observations(PyPool *self, const Playing *playing, PyObject *seen,
                                     PyRollout *r) {
    const Settings *s = &self->pool.settings;
    const size_t count = playing->judgement.program.number_of_seen;
    PyTurn *t = &r->turn;

    if (count == 0 && !PyTuple_Check(seen)) {
        return take_bytes(seen, &t->buffers[SEEN], PyBUF_WRITABLE,
                          r->horizon * s->count * s->num_observed * sizeof(float));
    }
    for (size_t i = 0; i < count; i++) {
        const size_t size = (size_t)playing->judgement.seen_bytes[i];
        PyObject *array = PyTuple_Check(seen) ? PyTuple_GetItem(seen, (Py_ssize_t)i) : seen;
        if (array == NULL ||
            !take_bytes(array, &t->seen_buffers[i], PyBUF_WRITABLE, r->horizon * size)) {
            return false;
        }
        t->seen[i] = t->seen_buffers[i].buf;
        t->seen_sizes[i] = size / s->count;
    }
    return true;
}

static bool take_rollout(PyPool *self, const Playing *playing, PyObject *const *args,
                         PyRollout *r) {
    const Py_ssize_t n = (Py_ssize_t)self->pool.settings.count;
    const Actions *a = &playing->play.actions;
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
           take_matrix(args[DRAWN], &b[DRAWN], WRITTEN, "drawn", ITEM_FLOAT64,
                       (Py_ssize_t)playing->play.draws->count, n);
}

static bool take_left_out(PyPool *self, PyObject *mask, PyRollout *r) {
    Py_buffer *buffer = &r->turn.buffers[MASK];

    if (!take_vector(mask, buffer, COPIED, "the mask", ITEM_BOOLEAN,
                     (Py_ssize_t)self->pool.settings.count)) {
        return false;
    }
    r->left_out = (Mask){buffer->buf, buffer->strides[0]};
    return true;
}

/* The mask may be NULL. */
static PyObject *roll_out(PyPool *self, PyObject *capsule, PyObject *const *args, PyObject *mask) {
    const Playing *playing = PyCapsule_GetPointer(capsule, PLAYING);
    PyRollout r = {.horizon = 0};
    bool done = false;

    clear_turn(playing, &r.turn);
    if (take_rollout(self, playing, args, &r) && (mask == NULL || take_left_out(self, mask, &r))) {
        settle_turn(self, playing, &r.turn);
        done = perform(self, NEVER_SHORT, do_rollout, &r) && !is_outside(&r.turn) &&
               report_messages(self);
    }
    if (done && r.turn.bad_action) {
        PyErr_SetString(PyExc_ValueError, "an action is out of range");
        done = false;
    }
    release_turn(playing, &r.turn);
    return done ? PyLong_FromSize_t(r.turn.troubled) : NULL;
}

PyObject *py_rollout(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;

    if (!has_arguments(nargs, nargs == LAST + 1 ? nargs : LAST) || !is_prepared(self)) {
        return NULL;
    }
    PyObject *playing = Py_NewRef(self->playing);
    PyObject *result = roll_out(self, playing, args, nargs > LAST ? args[LAST] : NULL);
    Py_DECREF(playing);
    return result;
}

/* Starting episodes outside of a step */

/* Sets ended to 1 if any episode is at its end now, 0 otherwise. */
static void do_start(PyPool *self, bool alone, void *context) {
    PyTurn *t = context;
    const Play *play = t->turn.play;

    t->call.alone = alone;
    t->ends.outside = false;
    t->troubled = pool_start(&self->pool, &t->call, &t->ends.outside);
    t->ends.ended = memchr(play->ended, 1, play->count) != NULL;
}

static bool take_start_arrays(PyPool *self, const Playing *playing, PyObject *const *args,
                              PyTurn *t) {
    const Py_ssize_t n = (Py_ssize_t)self->pool.settings.count;
    Py_buffer *b = t->buffers;

    return take_vector(args[0], &b[MASK], COPIED, "the mask", ITEM_BOOLEAN, n) &&
           take_observations(self, playing, args[1], t) &&
           take_matrix(args[2], &b[DRAWN], WRITTEN, "drawn", ITEM_FLOAT64,
                       (Py_ssize_t)playing->play.draws->count, n);
}

/* How many instances had trouble, and whether any episode is at its end now. */
static PyObject *start_result(const PyTurn *t) {
    return Py_BuildValue("(nO)", (Py_ssize_t)t->troubled, t->ends.ended ? Py_True : Py_False);
}

static PyObject *start_with(PyPool *self, PyObject *capsule, PyObject *const *args) {
    const Playing *playing = PyCapsule_GetPointer(capsule, PLAYING);
    PyTurn t;
    bool done = false;

    clear_turn(playing, &t);
    if (take_start_arrays(self, playing, args, &t)) {
        settle_turn(self, playing, &t);
        t.call.mask = (Mask){t.buffers[MASK].buf, t.buffers[MASK].strides[0]};
        done = perform(self, RESET, do_start, &t) && !is_outside(&t) && report_messages(self);
    }
    release_turn(playing, &t);
    return done ? start_result(&t) : NULL;
}

PyObject *py_start(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;

    if (!has_arguments(nargs, 3) || !is_prepared(self)) {
        return NULL;
    }
    PyObject *playing = Py_NewRef(self->playing);
    PyObject *result = start_with(self, playing, args);
    Py_DECREF(playing);
    return result;
}
