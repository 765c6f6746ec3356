/* The methods of the type Pool for states as bytes and for records: see bundles.h, records.h. */

#include <stdlib.h>
#include <string.h>

#include "../bundles.h"
#include "../records.h"
#include "python.h"

static bool are_instances(const PyPool *self, const int64_t *indices, size_t count) {
    for (size_t i = 0; i < count; i++) {
        if (indices[i] < 0 || (size_t)indices[i] >= self->pool.settings.count) {
            PyErr_Format(PyExc_IndexError, "there is no instance %lld", (long long)indices[i]);
            return false;
        }
    }
    return true;
}

/* Copies a vector of integers, because its owner may change it at any time. */
static int64_t *copy_of(PyObject *object, const char *name, Py_ssize_t length, size_t *count) {
    Py_buffer buffer = {.obj = NULL};

    if (!take_vector(object, &buffer, IN_PLACE, name, ITEM_INT64, length)) {
        return NULL;
    }
    const size_t number = (size_t)buffer.shape[0];
    int64_t *copy = malloc((number + 1) * sizeof *copy);
    if (copy == NULL) {
        PyErr_NoMemory();
    } else {
        memcpy(copy, buffer.buf, number * sizeof *copy);
    }
    release_buffer(&buffer);
    *count = number;
    return copy;
}

/* Saving */

typedef struct {
    int64_t *indices;
    size_t count;
    Py_buffer ends, steps, start_times;
    Bundle bundle;
    ptrdiff_t failed;
} Saving;

static void do_bundle(PyPool *self, bool alone, void *context) {
    Saving *s = context;
    (void)alone;
    s->failed =
        pool_bundle(&self->pool, s->indices, s->count, &s->bundle, s->ends.buf, s->steps.buf,
                    s->start_times.buf);
}

static bool take_saving(PyPool *self, PyObject *const *args, Saving *s) {
    s->indices = copy_of(args[0], "the indices", ANY_LENGTH, &s->count);
    return s->indices != NULL && are_instances(self, s->indices, s->count) &&
           take_vector(args[1], &s->ends, WRITTEN, "the ends", ITEM_INT64,
                       (Py_ssize_t)s->count) &&
           take_vector(args[2], &s->steps, WRITTEN, "the steps", ITEM_INT64,
                       (Py_ssize_t)s->count) &&
           take_vector(args[3], &s->start_times, WRITTEN, "the start times", ITEM_FLOAT64,
                       (Py_ssize_t)s->count);
}

static bool can_serialize(const PyPool *self) {
    const Fmi *fmi = self->pool.settings.fmi;
    const bool able = self->pool.settings.can_save && fmi->serialize != NULL;

    if (!able) {
        PyErr_SetString(PyExc_ValueError, "the FMU cannot serialize its state");
    }
    return able;
}

PyObject *py_bundle(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Saving s = {.indices = NULL};
    PyObject *result = NULL;

    if (has_arguments(nargs, 4) && can_serialize(self) && take_saving(self, args, &s) &&
        perform(self, NEVER_SHORT, do_bundle, &s) && report_messages(self)) {
        result = s.failed >= 0
                     ? PyLong_FromSsize_t(s.failed)
                     : PyBytes_FromStringAndSize(s.bundle.bytes, (Py_ssize_t)s.bundle.size);
    }
    release_buffer(&s.ends);
    release_buffer(&s.steps);
    release_buffer(&s.start_times);
    free(s.indices);
    free(s.bundle.bytes);
    return result;
}

/* Restoring */

typedef struct {
    States states;
    int64_t *indices;
    size_t count;
    Py_buffer start_times, outputs;
    size_t troubled;
} Restoring;

static void do_unbundle(PyPool *self, bool alone, void *context) {
    Restoring *r = context;
    (void)alone;
    for (size_t i = 0; i < r->count; i++) {
        self->pool.chosen[i] = (uint32_t)r->indices[i];
    }
    r->troubled = pool_unbundle(&self->pool, &r->states, r->count);
}

/* Each instance may be restored once in a call, so that no two threads work on it. */
static bool are_different(const PyPool *self, const Restoring *r) {
    const size_t count = self->pool.settings.count;
    char *seen = calloc(count, 1);
    bool different = seen != NULL && r->count <= count;

    for (size_t i = 0; different && i < r->count; i++) {
        different = !seen[r->indices[i]];
        seen[r->indices[i]] = 1;
    }
    free(seen);
    if (!different) {
        PyErr_SetString(PyExc_ValueError, "an instance is to be restored twice");
    }
    return different;
}

static bool are_sound(const Restoring *r, Py_ssize_t size) {
    const States *s = &r->states;
    int64_t end = 0;
    bool sound = true;

    for (size_t i = 0; i < s->count; i++) {
        sound = sound && s->ends[i] >= end && s->ends[i] <= (int64_t)size;
        end = s->ends[i];
    }
    for (size_t i = 0; i < r->count; i++) {
        sound = sound && s->sources[i] >= 0 && (size_t)s->sources[i] < s->count;
    }
    if (!sound) {
        PyErr_SetString(PyExc_ValueError, "the states are damaged");
    }
    return sound;
}

static bool take_restoring(PyPool *self, PyObject *const *args, Restoring *r) {
    States *s = &r->states;
    size_t unused;
    char *bytes;
    Py_ssize_t size;

    if (PyBytes_AsStringAndSize(args[2], &bytes, &size) < 0) {
        return false;
    }
    s->bytes = bytes;
    r->indices = copy_of(args[0], "the indices", ANY_LENGTH, &r->count);
    s->sources = r->indices == NULL
                     ? NULL
                     : copy_of(args[1], "the sources", (Py_ssize_t)r->count, &unused);
    s->ends = copy_of(args[3], "the ends", ANY_LENGTH, &s->count);
    s->steps = s->ends == NULL ? NULL
                               : copy_of(args[4], "the steps", (Py_ssize_t)s->count, &unused);
    return s->sources != NULL && s->steps != NULL && are_instances(self, r->indices, r->count) &&
           are_different(self, r) && are_sound(r, size) &&
           take_vector(args[5], &r->start_times, IN_PLACE, "the start times", ITEM_FLOAT64,
                       (Py_ssize_t)s->count) &&
           take_matrix(args[6], &r->outputs, IN_PLACE, "the outputs", ITEM_FLOAT64,
                       (Py_ssize_t)self->pool.settings.outputs->count, (Py_ssize_t)s->count);
}

PyObject *py_unbundle(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Restoring r = {.indices = NULL};
    PyObject *result = NULL;

    if (has_arguments(nargs, 7) && can_serialize(self) && take_restoring(self, args, &r)) {
        r.states.start_times = r.start_times.buf;
        r.states.outputs = r.outputs.buf;
        if (perform(self, NEVER_SHORT, do_unbundle, &r) && report_messages(self)) {
            result = PyLong_FromSize_t(r.troubled);
        }
    }
    release_buffer(&r.start_times);
    release_buffer(&r.outputs);
    free(r.indices);
    free(r.states.sources);
    free(r.states.ends);
    free(r.states.steps);
    return result;
}

/* Records */

static void do_keep(PyPool *self, bool alone, void *context) {
    (void)alone;
    *(bool *)context = records_open(&self->pool);
}

PyObject *py_keep_records(PyObject *object, PyObject *unused) {
    bool done = false;

    (void)unused;
    if (!perform((PyPool *)object, ALWAYS_SHORT, do_keep, &done)) {
        return NULL;
    }
    if (!done) {
        return PyErr_NoMemory();
    }
    Py_RETURN_NONE;
}

typedef struct {
    int64_t index;
    const Access *start;
    const char *starts, *inputs;
    size_t rows;
} Replacing;

static void do_replace(PyPool *self, bool alone, void *context) {
    const Replacing *r = context;
    const size_t index = (size_t)r->index, width = self->pool.settings.inputs->count;

    (void)alone;
    record_begin(&self->pool, index, r->start, (const double *)(const void *)r->starts);
    for (size_t row = 0; row < r->rows; row++) { /* the data of bytes are aligned to 8 bytes */
        record_add(&self->pool, index, (const double *)(const void *)r->inputs + row * width);
    }
}

/* Takes an index, an Access, and as bytes the start values and the inputs; and how many steps. */
static bool take_replacing(PyPool *self, PyObject *const *args, Replacing *r) {
    char *starts, *inputs;
    Py_ssize_t size_of_starts, size_of_inputs;

    r->index = PyNumber_AsSsize_t(args[0], PyExc_IndexError);
    r->rows = PyLong_AsSize_t(args[4]);
    if (PyErr_Occurred() || !are_instances(self, &r->index, 1) || !is_access(self, args[1]) ||
        PyBytes_AsStringAndSize(args[2], &starts, &size_of_starts) < 0 ||
        PyBytes_AsStringAndSize(args[3], &inputs, &size_of_inputs) < 0) {
        return false;
    }
    const size_t row = self->pool.settings.inputs->count * sizeof(double);
    r->start = &((PyAccess *)args[1])->access;
    r->starts = starts;
    r->inputs = inputs;
    const bool fits = (size_t)size_of_starts == r->start->count * sizeof(double) &&
                      (row == 0 ? size_of_inputs == 0
                                : (size_t)size_of_inputs % row == 0 &&
                                      (size_t)size_of_inputs / row == r->rows);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "the record is damaged");
    }
    return fits;
}

PyObject *py_replace_record(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Replacing replacing = {.rows = 0};

    if (!has_arguments(nargs, 5) || !take_replacing(self, args, &replacing) ||
        !perform(self, ALWAYS_SHORT, do_replace, &replacing)) {
        return NULL;
    }
    Py_RETURN_NONE;
}

typedef struct {
    size_t index;
    Record record; /* a copy */
    bool found, out_of_memory;
} Looking;

static void do_look(PyPool *self, bool alone, void *context) {
    Looking *l = context;
    const Pool *pool = &self->pool;

    (void)alone;
    if (record_is_whole(pool, l->index)) {
        l->found = true;
        l->out_of_memory = !record_copy(pool, l->index, &l->record);
    }
}

static PyObject *starts_of(const Record *record) {
    const Py_ssize_t count = (Py_ssize_t)record->number_of_starts;
    PyObject *starts = PyTuple_New(count);

    for (Py_ssize_t i = 0; starts != NULL && i < count; i++) {
        const RecordedStart *start = &record->starts[i];
        PyObject *item =
            Py_BuildValue("(IIId)", start->type, start->reference, start->place, start->value);
        if (item == NULL || PyTuple_SetItem(starts, i, item) < 0) {
            Py_CLEAR(starts);
        }
    }
    return starts;
}

/* Returns the starts as (type, value reference, place, value), the number of steps, and their inputs as
 * bytes. */
PyObject *py_record_of(PyObject *object, PyObject *index) {
    PyPool *self = (PyPool *)object;
    Looking l = {.found = false};
    const int64_t number = PyNumber_AsSsize_t(index, PyExc_IndexError);
    PyObject *result = NULL;

    if (PyErr_Occurred() || !are_instances(self, &number, 1)) {
        return NULL;
    }
    l.index = (size_t)number;
    if (!perform(self, ALWAYS_SHORT, do_look, &l)) {
        return NULL;
    }
    if (l.out_of_memory) {
        result = PyErr_NoMemory();
    } else if (!l.found) {
        result = Py_NewRef(Py_None);
    } else {
        const size_t size = l.record.rows * self->pool.settings.inputs->count * sizeof(double);
        result = Py_BuildValue("(Nny#)", starts_of(&l.record), (Py_ssize_t)l.record.rows,
                               (const char *)l.record.inputs, (Py_ssize_t)size);
    }
    record_clear(&l.record);
    return result;
}
