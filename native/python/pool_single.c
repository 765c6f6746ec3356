/* The methods of the type Pool for the steps of a single environment: see single.h. */

#include <stdlib.h>
#include <string.h>

#include "halves.h"
#include "programs.h"
#include "single.h"

enum { NEXT, CURRENT, PREVIOUS, WANTED, KEPT, STEP_COUNT, SINGLE_BUFFERS };

static const char *const SINGLE = "fmugym._native.single";

enum { MOST_DIMENSIONS = 8 };

/* An attribute of the environment that its programs depend on. */
typedef struct {
    PyObject *name, *value;
    PyObject *copy; /* equals the value as long as that has not changed in place; may be NULL */
    Py_buffer memory; /* of an array, of which the copy has the bytes */
} Watched;

/* The result of prepare_single. It never changes; the next call replaces it as a whole. */
typedef struct {
    Single single;
    PyProgram inputs, judgement;
    Py_buffer buffers[SINGLE_BUFFERS], seen_buffers[MOST_SEEN];
    char *seen[MOST_SEEN];
    Py_buffer *row_buffers; /* two for each row */
    size_t number_of_row_buffers;
    KeptRow *rows;
    Watched *watched;
    size_t number_of_watched;
    Register *memory;
    Registers input_registers, judgement_registers;
    PyObject *action_type; /* the class of actions, in addition to int */
    PyObject *copies, *names; /* make the observation: functions, and names or None */
    bool is_integer;
    long long lowest, highest;
    int dimensions;
    Py_ssize_t shape[MOST_DIMENSIONS + 1];
    char letter; /* the type of an array's elements */
} Prepared;

static void prepared_free(Prepared *p) {
    for (int i = 0; i < SINGLE_BUFFERS; i++) {
        release_buffer(&p->buffers[i]);
    }
    for (int i = 0; i < MOST_SEEN; i++) {
        release_buffer(&p->seen_buffers[i]);
    }
    for (size_t i = 0; i < p->number_of_row_buffers; i++) {
        release_buffer(&p->row_buffers[i]);
    }
    for (size_t i = 0; i < p->number_of_watched; i++) {
        release_buffer(&p->watched[i].memory);
        Py_XDECREF(p->watched[i].name);
        Py_XDECREF(p->watched[i].value);
        Py_XDECREF(p->watched[i].copy);
    }
    free(p->row_buffers);
    free(p->rows);
    free(p->watched);
    free(p->memory);
    release_program(&p->inputs);
    release_program(&p->judgement);
    Py_XDECREF(p->action_type);
    Py_XDECREF(p->copies);
    Py_XDECREF(p->names);
    free(p);
}

static void prepared_dealloc(PyObject *capsule) {
    prepared_free(PyCapsule_GetPointer(capsule, SINGLE));
}

/* Preparing */

static bool take_shape(Prepared *p, PyObject *shape) {
    const Py_ssize_t dimensions = PyTuple_Size(shape);
    size_t elements = 1;

    for (Py_ssize_t i = 0; i < dimensions && i < MOST_DIMENSIONS; i++) {
        p->shape[i] = PyLong_AsSsize_t(PyTuple_GetItem(shape, i));
        elements *= p->shape[i] < 0 || p->shape[i] > UINT16_MAX ? 0 : (size_t)p->shape[i];
    }
    if (PyErr_Occurred()) {
        return false;
    }
    if (dimensions > MOST_DIMENSIONS || elements == 0 || elements > UINT16_MAX) {
        PyErr_SetString(PyExc_ValueError, "an action has no elements, or too many");
        return false;
    }
    p->dimensions = (int)dimensions;
    p->single.elements = elements;
    return true;
}

static bool take_actions(Prepared *p, PyObject *group) {
    static char *names[] = {"type",    "shape", "letter",  "is_integer", "lowest",
                            "highest", "next",  "current", "previous",   NULL};
    PyObject *type, *shape, *next, *current, *previous;
    int letter, is_integer;
    Py_buffer *b = p->buffers;

    if (!parse_group(group, "$OO!CpLLOOO:actions", names, &type, &PyTuple_Type, &shape, &letter,
                     &is_integer, &p->lowest, &p->highest, &next, &current, &previous) ||
        !take_shape(p, shape)) {
        return false;
    }
    const Py_ssize_t length = (Py_ssize_t)p->single.elements;
    p->action_type = Py_NewRef(type);
    p->letter = (char)letter;
    p->is_integer = is_integer != 0;
    if (!take_numbers(next, &b[NEXT], true, "the next action", length) ||
        !take_numbers(current, &b[CURRENT], true, "the action", length) ||
        !take_numbers(previous, &b[PREVIOUS], true, "the previous action", length)) {
        return false;
    }
    p->single.size = (size_t)b[NEXT].itemsize;
    if (b[CURRENT].itemsize != b[NEXT].itemsize || b[PREVIOUS].itemsize != b[NEXT].itemsize ||
        (p->is_integer && b[NEXT].itemsize != sizeof(int64_t))) {
        PyErr_SetString(PyExc_ValueError, "actions differ in type");
        return false;
    }
    return true;
}

static bool take_row(Prepared *p, PyObject *pair, KeptRow *row) {
    PyObject *now, *before;
    Py_buffer *first = &p->row_buffers[p->number_of_row_buffers++];
    Py_buffer *second = &p->row_buffers[p->number_of_row_buffers++];

    if (!PyArg_ParseTuple(pair, "OO;a row is an array and its copy", &now, &before) ||
        !take_numbers(now, first, true, "an episode variable", 1) ||
        !take_numbers(before, second, true, "an episode variable", 1)) {
        return false;
    }
    if (first->itemsize != second->itemsize) {
        PyErr_SetString(PyExc_ValueError, "an episode variable and its copy differ in type");
        return false;
    }
    *row = (KeptRow){first->buf, second->buf, (size_t)first->itemsize};
    return true;
}

static bool take_rows(Prepared *p, PyObject *rows) {
    const Py_ssize_t count = PyTuple_Size(rows);

    p->row_buffers = calloc(2 * (size_t)count + 1, sizeof *p->row_buffers);
    p->rows = calloc((size_t)count + 1, sizeof *p->rows);
    if (p->row_buffers == NULL || p->rows == NULL) {
        PyErr_NoMemory();
        return false;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        if (!take_row(p, PyTuple_GetItem(rows, i), &p->rows[i])) {
            return false;
        }
    }
    p->single.rows = p->rows;
    p->single.number_of_rows = (size_t)count;
    return true;
}

static bool take_watch(PyObject *item, Watched *w) {
    if (!PyArg_ParseTuple(item, "UOO;what is watched is a name, a value and a copy", &w->name,
                          &w->value, &w->copy)) {
        return false;
    }
    Py_INCREF(w->name);
    Py_INCREF(w->value);
    Py_INCREF(w->copy);
    if (!PyBytes_Check(w->copy)) {
        return true;
    }
    if (PyObject_GetBuffer(w->value, &w->memory, PyBUF_C_CONTIGUOUS) < 0) {
        return false;
    }
    if (w->memory.len != PyBytes_Size(w->copy)) {
        PyErr_SetString(PyExc_ValueError, "an array and its copy differ in size");
        return false;
    }
    return true;
}

static bool take_watched(Prepared *p, PyObject *watched) {
    const Py_ssize_t count = PyTuple_Size(watched);

    p->watched = calloc((size_t)count + 1, sizeof *p->watched);
    if (p->watched == NULL) {
        PyErr_NoMemory();
        return false;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        if (!take_watch(PyTuple_GetItem(watched, i), &p->watched[p->number_of_watched++])) {
            return false;
        }
    }
    return true;
}

static bool take_memory(const PyPool *self, Prepared *p, PyObject *wanted, PyObject *kept,
                        PyObject *step_count) {
    const Settings *s = &self->pool.settings;
    Py_buffer *b = p->buffers;

    if (!take_vector(wanted, &b[WANTED], WRITTEN, "wanted", ITEM_FLOAT64,
                     (Py_ssize_t)s->inputs->count) ||
        !take_vector(kept, &b[KEPT], WRITTEN, "kept", ITEM_FLOAT64,
                     (Py_ssize_t)s->outputs->count) ||
        !take_vector(step_count, &b[STEP_COUNT], WRITTEN, "step_count", ITEM_INT64, 1)) {
        return false;
    }
    p->single.wanted = b[WANTED].buf;
    p->single.kept = b[KEPT].buf;
    p->single.step_count = b[STEP_COUNT].buf;
    p->single.inputs_row = self->buffers[INPUTS].buf;
    p->single.next = b[NEXT].buf;
    p->single.current = b[CURRENT].buf;
    p->single.previous = b[PREVIOUS].buf;
    return true;
}

/* The compiler expects registers to be aligned. */
static bool take_registers(Prepared *p) {
    const Program *inputs = &p->inputs.program, *judgement = &p->judgement.program;
    char *memory = malloc((inputs->registers + judgement->registers + 1) * sizeof(Register));

    p->memory = (Register *)(void *)memory;
    if (memory == NULL) {
        PyErr_NoMemory();
        return false;
    }
    Register *aligned = (Register *)(void *)(memory + (64 - (uintptr_t)memory % 64) % 64);
    program_prepare(inputs, aligned, &p->input_registers);
    program_prepare(judgement, aligned + inputs->registers, &p->judgement_registers);
    p->single.input_registers = &p->input_registers;
    p->single.judgement_registers = &p->judgement_registers;
    return true;
}

static bool is_sound(const PyPool *self, const Prepared *p) {
    const Py_ssize_t copies = PyTuple_Size(p->copies);
    const bool sound = self->pool.settings.count == 1 && p->inputs.program.number_of_seen == 0 &&
                       p->judgement.program.number_of_results == PROGRAM_RESULTS && copies > 0 &&
                       (p->names == Py_None ? copies == 1 : PyTuple_Size(p->names) == copies);
    if (!sound && !PyErr_Occurred()) {
        PyErr_SetString(PyExc_ValueError, "a program does not fit the pool");
    }
    return sound;
}

static bool fill(const PyPool *self, Prepared *p, PyObject *args, PyObject *kwargs) {
    static char *names[] = {"inputs",  "judgement", "actions", "rows",     "wanted",
                            "kept",    "episode",   "limit",   "seen",     "copies",
                            "names",   "observed",  "watched", NULL};
    PyObject *inputs, *judgement, *actions, *rows, *wanted, *kept, *episode, *seen, *watched;
    PyObject *copies, *keys;
    long long limit;
    int observed;

    if (!PyArg_ParseTupleAndKeywords(
            args, kwargs, "$O!O!O!O!OOOLOO!OpO!:prepare_single", names, &PyTuple_Type, &inputs,
            &PyTuple_Type, &judgement, &PyDict_Type, &actions, &PyTuple_Type, &rows, &wanted,
            &kept, &episode, &limit, &seen, &PyTuple_Type, &copies, &keys, &observed,
            &PyTuple_Type, &watched)) {
        return false;
    }
    p->copies = Py_NewRef(copies);
    p->names = Py_NewRef(keys);
    p->single.limit = limit;
    p->single.observed = observed != 0;
    if (!take_actions(p, actions) ||
        !take_program(inputs, 1, p->single.elements, &p->inputs) ||
        !take_program(judgement, 1, p->single.elements, &p->judgement) || !take_rows(p, rows) ||
        !take_memory(self, p, wanted, kept, episode) || !take_watched(p, watched) ||
        !take_seen(&p->judgement, seen, p->seen_buffers, p->seen) || !take_registers(p)) {
        return false;
    }
    p->single.inputs = p->inputs.program;
    p->single.judgement = p->judgement.program;
    p->single.seen = p->seen;
    return is_sound(self, p);
}

PyObject *py_prepare_single(PyObject *object, PyObject *args, PyObject *kwargs) {
    PyPool *self = (PyPool *)object;
    Prepared *p = calloc(1, sizeof *p);
    PyObject *before = self->single, *capsule = NULL;

    if (p == NULL) {
        return PyErr_NoMemory();
    }
    if (fill(self, p, args, kwargs)) {
        capsule = PyCapsule_New(p, SINGLE, prepared_dealloc);
    }
    if (capsule == NULL) {
        prepared_free(p);
        return NULL;
    }
    self->single = capsule;
    Py_XDECREF(before);
    Py_RETURN_NONE;
}

/* Stepping */

/* Whether the environment still has all attributes that the programs were made of, and no others
 * than those that it had then. Returns -1 with an exception if a comparison fails. */
static int is_as_before(const Prepared *p, PyObject *attributes, Py_ssize_t size) {
    if (PyDict_Size(attributes) != size) {
        return 0;
    }
    for (size_t i = 0; i < p->number_of_watched; i++) {
        const Watched *w = &p->watched[i];
        if (PyDict_GetItemWithError(attributes, w->name) != w->value) {
            return PyErr_Occurred() ? -1 : 0;
        }
        if (w->memory.buf != NULL) {
            if (memcmp(w->memory.buf, PyBytes_AsString(w->copy), (size_t)w->memory.len) != 0) {
                return 0;
            }
        } else if (w->copy != Py_None) {
            const int same = PyObject_RichCompareBool(w->value, w->copy, Py_EQ);
            if (same != 1) {
                return same;
            }
        }
    }
    return 1;
}

/* Whether this is an integer of the range. Sets no exception. */
static bool take_integer(const Prepared *p, PyObject *action) {
    long long number = 0;

    if (PyLong_CheckExact(action)) {
        number = PyLong_AsLongLong(action);
    } else if ((PyObject *)Py_TYPE(action) == p->action_type) {
        PyObject *integer = PyNumber_Index(action);
        number = integer == NULL ? 0 : PyLong_AsLongLong(integer);
        Py_XDECREF(integer);
    } else {
        return false;
    }
    if (PyErr_Occurred()) {
        PyErr_Clear();
        return false;
    }
    *(int64_t *)(void *)p->single.next = number;
    return p->lowest <= number && number <= p->highest;
}

static bool fits(const Prepared *p, const Py_buffer *b) {
    bool same = b->ndim == p->dimensions && b->itemsize == (Py_ssize_t)p->single.size &&
                b->format != NULL && b->format[0] == p->letter && b->format[1] == '\0';

    for (int i = 0; same && i < b->ndim; i++) {
        same = b->shape[i] == p->shape[i];
    }
    return same;
}

static bool is_nan(char letter, const void *values, size_t i) {
    const double *doubles = values;
    const float *floats = values;
    const Half *halves = values;

    switch (letter) {
    case 'd':
        return doubles[i] != doubles[i];
    case 'f':
        return floats[i] != floats[i];
    default:
        return letter == 'e' && half_is_nan(halves[i]);
    }
}

static bool has_nan(const Prepared *p) {
    bool found = false;

    for (size_t i = 0; i < p->single.elements && !found; i++) {
        found = is_nan(p->letter, p->single.next, i);
    }
    return found;
}

/* Whether this is an array as the action space has it, without NaN. Sets no exception. */
static bool take_array(const Prepared *p, PyObject *action) {
    Py_buffer b;

    if ((PyObject *)Py_TYPE(action) != p->action_type) {
        return false;
    }
    if (PyObject_GetBuffer(action, &b, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        PyErr_Clear();
        return false;
    }
    const bool good = fits(p, &b);
    if (good) {
        memcpy(p->single.next, b.buf, (size_t)b.len);
    }
    PyBuffer_Release(&b);
    return good && !has_nan(p);
}

typedef struct {
    const Prepared *prepared;
    Call call;
    size_t troubled;
    SingleOutcome outcome;
    SingleResult result;
} Stepping;

static void do_single(PyPool *self, bool alone, void *context) {
    Stepping *s = context;

    s->call.alone = alone;
    s->outcome = single_step(&self->pool, &s->prepared->single, &s->call, &s->result);
}

static void do_before(PyPool *self, bool alone, void *context) {
    Stepping *s = context;

    (void)alone;
    s->outcome = single_before(&self->pool, &s->prepared->single) ? SINGLE_DONE : SINGLE_REFUSED;
}

static void do_after(PyPool *self, bool alone, void *context) {
    Stepping *s = context;

    (void)alone;
    s->outcome = single_after(&self->pool, &s->prepared->single, s->troubled, &s->result);
}

static PyObject *observation_of(const Prepared *p) {
    if (p->names == Py_None) {
        return PyObject_CallNoArgs(PyTuple_GetItem(p->copies, 0));
    }
    PyObject *observation = PyDict_New();
    for (Py_ssize_t i = 0; observation != NULL && i < PyTuple_Size(p->copies); i++) {
        PyObject *part = PyObject_CallNoArgs(PyTuple_GetItem(p->copies, i));
        if (part == NULL || PyDict_SetItem(observation, PyTuple_GetItem(p->names, i), part) < 0) {
            Py_CLEAR(observation);
        }
        Py_XDECREF(part);
    }
    return observation;
}

static PyObject *result_of(const Stepping *s) {
    PyObject *parts[] = {observation_of(s->prepared), PyFloat_FromDouble(s->result.reward),
                         PyBool_FromLong(s->result.terminated),
                         PyBool_FromLong(s->result.truncated), PyDict_New()};
    PyObject *result = PyTuple_New(5);
    bool good = result != NULL;

    for (int i = 0; i < 5; i++) {
        good = good && parts[i] != NULL;
    }
    for (int i = 0; i < 5; i++) {
        if (good) {
            PyTuple_SetItem(result, i, parts[i]); /* which takes over the reference */
        } else {
            Py_XDECREF(parts[i]);
        }
    }
    if (!good) {
        Py_CLEAR(result);
    }
    return result;
}

static void replace_reference(PyObject **place, PyObject *object) {
    PyObject *before = *place;

    *place = object;
    Py_XDECREF(before);
}

static void note_action(PyPool *self, PyObject *action) {
    replace_reference(&self->actions[1], self->actions[0]);
    self->actions[0] = Py_NewRef(action);
}

static PyObject *before_with(PyPool *self, const Prepared *p, PyObject *action) {
    Stepping s = {.prepared = p};

    if (!perform(self, ALWAYS_SHORT, do_before, &s)) {
        return NULL;
    }
    if (s.outcome == SINGLE_REFUSED) {
        Py_RETURN_NONE;
    }
    note_action(self, action);
    Py_RETURN_TRUE;
}

static PyObject *step_with(PyPool *self, const Prepared *p, PyObject *action) {
    const Py_buffer *inputs = &self->buffers[INPUTS];
    Stepping s = {.prepared = p,
                  .call = {.inputs = {inputs->buf, inputs->strides[0], inputs->strides[1]},
                           .observations = self->buffers[OBSERVATIONS].buf}};

    if (!perform(self, STEP, do_single, &s)) {
        return NULL;
    }
    if (s.outcome == SINGLE_REFUSED) {
        Py_RETURN_NONE;
    }
    note_action(self, action);
    if (!report_messages(self)) {
        return NULL;
    }
    return s.outcome == SINGLE_TROUBLED ? PyBool_FromLong(0) : result_of(&s);
}

typedef PyObject *WithAction(PyPool *self, const Prepared *prepared, PyObject *action);

/* Takes an action, the attributes of the environment, and how many there must be. Returns None
 * without any further work if they are not as they were prepared. */
static PyObject *do_with(PyPool *self, WithAction *work, PyObject *const *args, Py_ssize_t nargs) {
    if (!has_arguments(nargs, 3)) {
        return NULL;
    }
    if (self->single == NULL || !PyDict_Check(args[1])) {
        PyErr_SetString(PyExc_TypeError, "step_single was not prepared, or gets no dict");
        return NULL;
    }
    PyObject *capsule = Py_NewRef(self->single);
    const Prepared *p = PyCapsule_GetPointer(capsule, SINGLE);
    const Py_ssize_t size = PyLong_AsSsize_t(args[2]);
    const int same = PyErr_Occurred() ? -1 : is_as_before(p, args[1], size);
    PyObject *result = NULL;
    if (same == 1 && (p->is_integer ? take_integer(p, args[0]) : take_array(p, args[0]))) {
        result = work(self, p, args[0]);
    } else if (same >= 0) {
        result = Py_NewRef(Py_None);
    }
    Py_DECREF(capsule);
    return result;
}

PyObject *py_step_single(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    return do_with((PyPool *)object, step_with, args, nargs);
}

PyObject *py_before_single(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    return do_with((PyPool *)object, before_with, args, nargs);
}

/* Takes how many instances had trouble in the step. */
PyObject *py_after_single(PyObject *object, PyObject *troubled) {
    PyPool *self = (PyPool *)object;
    Stepping s = {.troubled = PyLong_AsSize_t(troubled)};

    if (PyErr_Occurred()) {
        return NULL;
    }
    if (self->single == NULL) {
        PyErr_SetString(PyExc_TypeError, "step_single was not prepared");
        return NULL;
    }
    PyObject *capsule = Py_NewRef(self->single), *result = NULL;
    s.prepared = PyCapsule_GetPointer(capsule, SINGLE);
    if (perform(self, ALWAYS_SHORT, do_after, &s)) {
        result = s.outcome == SINGLE_TROUBLED ? PyBool_FromLong(0) : result_of(&s);
    }
    Py_DECREF(capsule);
    return result;
}

/* Takes what counts as the action of the step before. */
PyObject *py_begin_single(PyObject *object, PyObject *action) {
    PyPool *self = (PyPool *)object;

    replace_reference(&self->actions[1], Py_NewRef(action));
    replace_reference(&self->actions[0], Py_NewRef(action));
    Py_RETURN_NONE;
}

PyObject *py_actions_of_single(PyObject *object, PyObject *unused) {
    const PyPool *self = (PyPool *)object;

    (void)unused;
    if (self->actions[0] == NULL) {
        Py_RETURN_NONE;
    }
    return PyTuple_Pack(2, self->actions[0], self->actions[1]);
}
