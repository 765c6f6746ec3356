/* Takes what a single environment hands to prepare_single: programs, rows, actions, attributes. */

#include <stdlib.h>
#include <string.h>

#include "prepared.h"

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
