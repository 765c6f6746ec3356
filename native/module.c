/* The extension module fmugym._native: Python's view of the pool. See fmugym/_native.pyi. */

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stdlib.h>
#include <string.h>

#include "pool.h"

static PyTypeObject *access_type, *pool_type, *snapshot_type;

static PyObject *decode(const char *text) {
    return PyUnicode_DecodeUTF8(text == NULL ? "" : text,
                                text == NULL ? 0 : (Py_ssize_t)strlen(text), "replace");
}

/* Buffers */

static bool has_format(const Py_buffer *buffer, const char *formats) {
    const char *format = buffer->format == NULL ? "B" : buffer->format;
    if (*format == '@' || *format == '=') {
        format++;
    }
    return format[0] != '\0' && format[1] == '\0' && strchr(formats, format[0]) != NULL;
}

/* Takes an array of the given format and shape; rows of -1 stands for one dimension. */
static bool take_buffer(PyObject *object, Py_buffer *buffer, int flags, const char *name,
                        const char *formats, Py_ssize_t rows, Py_ssize_t columns) {
    const int dimensions = rows < 0 ? 1 : 2;

    if (PyObject_GetBuffer(object, buffer, flags | PyBUF_FORMAT) < 0) {
        return false;
    }
    if (!has_format(buffer, formats)) {
        PyErr_Format(PyExc_TypeError, "%s must be an array of type '%s'", name, formats);
    } else if (buffer->ndim != dimensions || buffer->shape[dimensions - 1] != columns ||
               (rows >= 0 && buffer->shape[0] != rows)) {
        PyErr_Format(PyExc_ValueError, "%s must have the shape (%zd, %zd)", name,
                     rows < 0 ? (Py_ssize_t)1 : rows, columns);
    } else {
        return true;
    }
    PyBuffer_Release(buffer);
    return false;
}

static void release(Py_buffer *buffer) {
    if (buffer->obj != NULL) {
        PyBuffer_Release(buffer);
    }
}

/* Access: a list of variables */

typedef struct {
    PyObject_HEAD
    Access access;
} PyAccess;

static const Fmi *fmi_of(int version) {
    static const Fmi *const versions[] = {&fmi1, &fmi2, &fmi3};
    if (version < 1 || version > 3) {
        PyErr_Format(PyExc_ValueError, "there is no FMI %d", version);
        return NULL;
    }
    return versions[version - 1];
}

static bool check_types(const uint8_t *types, Py_ssize_t count, Py_ssize_t size) {
    for (Py_ssize_t i = 0; i < count; i++) {
        if (types[i] >= NUMBER_OF_TYPES) {
            PyErr_SetString(PyExc_ValueError, "unknown C type");
            return false;
        }
    }
    if (size != count * (Py_ssize_t)sizeof(uint32_t)) {
        PyErr_SetString(PyExc_ValueError, "types and references differ in length");
        return false;
    }
    return true;
}

static PyObject *access_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) {
    const char *types, *references;
    Py_ssize_t count, size;
    int version;

    (void)kwargs;
    if (!PyArg_ParseTuple(args, "iy#y#", &version, &types, &count, &references, &size)) {
        return NULL;
    }
    const Fmi *fmi = fmi_of(version);
    if (fmi == NULL || !check_types((const uint8_t *)types, count, size)) {
        return NULL;
    }
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyAccess *self = (PyAccess *)allocate(type, 0);
    if (self != NULL && !access_open(&self->access, fmi, (const uint8_t *)types,
                                     (const uint32_t *)(const void *)references, (size_t)count)) {
        Py_DECREF(self);
        return PyErr_NoMemory();
    }
    return (PyObject *)self;
}

static void free_object(PyObject *object) {
    PyTypeObject *type = Py_TYPE(object);
    freefunc release_memory = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release_memory(object);
    Py_DECREF(type);
}

static void access_dealloc(PyObject *object) {
    access_close(&((PyAccess *)object)->access);
    free_object(object);
}

/* Snapshot: FMU states, freed with the last reference */

typedef struct {
    PyObject_HEAD
    Snapshot snapshot;
    PyObject *pool; /* keeps the memory of the pool, not its instances */
} PySnapshot;

static void snapshot_dealloc(PyObject *object) {
    PySnapshot *self = (PySnapshot *)object;
    snapshot_close(&self->snapshot);
    Py_XDECREF(self->pool);
    free_object(object);
}

/* Pool */

enum { INPUTS, OUTPUTS, STATUS, OBSERVATIONS, HEALTH, BUFFERS };
enum { STARTS, BLOCK, USED, LOW, WIDTH, ROWS, COUNTS, ENDED, PLAY_BUFFERS };

typedef struct {
    PyObject_HEAD
    Pool pool;
    PyObject *arguments; /* keeps alive what the settings point to */
    PyObject *callback;
    PyObject *arrays[BUFFERS]; /* borrowed from arguments */
    Py_buffer buffers[BUFFERS];
    const char **paths;
    StringValue *strings;
    bool open;
    bool can_play;
    PyObject *start; /* the Access of what play sets before initialization */
    Play play;
    Py_buffer play_buffers[PLAY_BUFFERS];
    PyObject *generators; /* keeps alive what the streams point to */
    const Stream **streams;
} PyPool;

typedef struct {
    PyObject *paths, *stop_time, *tolerance, *strings;
    PyAccess *inputs, *outputs;
    Py_ssize_t num_observed, count, threads;
    int version, private_libraries, logging, can_save, reset_method;
    long long substeps, warm_up_steps, retries;
} Arguments;

static bool parse(PyPool *self, PyObject *args, Arguments *a) {
    Settings *s = &self->pool.settings;
    return PyArg_ParseTuple(
        args, "iyyyO!pppidOOdLLLO!O!O!nnnOOOOOO", &a->version, &s->model, &s->token, &s->resources,
        &PyTuple_Type, &a->paths, &a->private_libraries, &a->logging, &a->can_save,
        &a->reset_method,
        &s->experiment.start_time, &a->stop_time, &a->tolerance, &s->time_step, &a->substeps,
        &a->warm_up_steps, &a->retries, &PyTuple_Type, &a->strings, access_type, &a->inputs, access_type,
        &a->outputs, &a->num_observed, &a->count, &a->threads, &self->arrays[INPUTS],
        &self->arrays[OUTPUTS], &self->arrays[STATUS], &self->arrays[OBSERVATIONS],
        &self->arrays[HEALTH], &self->callback);
}

static bool check_numbers(const Arguments *a) {
    const bool sound = a->count >= 1 && a->count <= INT32_MAX && a->threads >= 1 &&
                       a->substeps >= 1 && a->warm_up_steps >= 0 && a->num_observed >= 0 &&
                       a->retries >= 0 && a->retries < 31 && a->reset_method >= 0 &&
                       a->reset_method < RESET_METHODS && (a->retries == 0 || a->can_save) &&
                       (size_t)a->num_observed <= a->outputs->access.count;
    if (!sound) {
        PyErr_SetString(PyExc_ValueError, "a number is out of range");
    }
    return sound;
}

static bool take_optional(PyObject *object, bool *given, double *value) {
    *given = object != Py_None;
    *value = *given ? PyFloat_AsDouble(object) : 0.0;
    return !PyErr_Occurred();
}

static bool take_paths(PyPool *self, PyObject *paths, Py_ssize_t wanted) {
    const Py_ssize_t count = PyTuple_Size(paths);

    self->paths = calloc((size_t)count + 1, sizeof *self->paths);
    if (self->paths == NULL) {
        PyErr_NoMemory();
        return false;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        self->paths[i] = PyBytes_AsString(PyTuple_GetItem(paths, i));
        if (self->paths[i] == NULL) {
            return false;
        }
    }
    if (count != wanted) {
        PyErr_SetString(PyExc_ValueError, "the number of libraries does not fit");
    }
    return count == wanted;
}

static bool take_strings(PyPool *self, PyObject *strings) {
    const Py_ssize_t count = PyTuple_Size(strings);

    self->strings = calloc((size_t)count + 1, sizeof *self->strings);
    if (self->strings == NULL) {
        PyErr_NoMemory();
        return false;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        if (!PyArg_ParseTuple(PyTuple_GetItem(strings, i), "Iy", &self->strings[i].reference,
                              &self->strings[i].text)) {
            return false;
        }
    }
    return true;
}

static bool take_arrays(PyPool *self, const Arguments *a) {
    const Py_ssize_t n = a->count;
    const int writable = PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE;
    const Py_ssize_t in = (Py_ssize_t)a->inputs->access.count;
    const Py_ssize_t out = (Py_ssize_t)a->outputs->access.count;

    return take_buffer(self->arrays[INPUTS], &self->buffers[INPUTS], writable, "inputs", "d", in,
                       n) &&
           take_buffer(self->arrays[OUTPUTS], &self->buffers[OUTPUTS], writable, "outputs", "d",
                       out, n) &&
           take_buffer(self->arrays[STATUS], &self->buffers[STATUS], writable, "status", "b", -1,
                       n) &&
           take_buffer(self->arrays[OBSERVATIONS], &self->buffers[OBSERVATIONS], writable,
                       "observations", "f", n, a->num_observed) &&
           take_buffer(self->arrays[HEALTH], &self->buffers[HEALTH], writable, "health", "lq", n,
                       HEALTH_COUNTS);
}

static bool settle(PyPool *self, const Arguments *a) {
    Settings *s = &self->pool.settings;

    s->fmi = fmi_of(a->version);
    s->private_libraries = a->private_libraries;
    s->logging = a->logging;
    s->can_save = a->can_save && s->fmi != NULL && s->fmi->get_state != NULL;
    s->reset_method = s->can_save || a->reset_method != RESET_BY_RESTORE
                          ? (ResetMethod)a->reset_method
                          : RESET_BY_RESET;
    s->substeps = a->substeps;
    s->warm_up_steps = a->warm_up_steps;
    s->retries = s->can_save ? a->retries : 0;
    s->inputs = &a->inputs->access;
    s->outputs = &a->outputs->access;
    s->num_observed = (size_t)a->num_observed;
    s->count = (size_t)a->count;
    s->threads = (size_t)a->threads;
    s->paths = self->paths;
    s->strings = self->strings;
    s->number_of_strings = (size_t)PyTuple_Size(a->strings);
    s->output_values = self->buffers[OUTPUTS].buf;
    s->status = self->buffers[STATUS].buf;
    s->health = self->buffers[HEALTH].buf;
    return s->fmi != NULL &&
           take_optional(a->stop_time, &s->experiment.has_stop_time, &s->experiment.stop_time) &&
           take_optional(a->tolerance, &s->experiment.has_tolerance, &s->experiment.tolerance);
}

/* Messages go to Python after a call, on the thread that made it. */

static void report(PyPool *self, size_t index, int status, const char *category,
                   const char *text) {
    PyObject *result = PyObject_CallFunction(self->callback, "niNN", (Py_ssize_t)index, status,
                                             decode(category), decode(text));
    if (result == NULL) {
        PyErr_WriteUnraisable(self->callback);
    }
    Py_XDECREF(result);
}

static void drain(PyPool *self) {
    size_t dropped;

    for (Message *message = log_take(&self->pool.log, &dropped), *next; message != NULL;
         message = next) {
        next = message->next;
        report(self, message->index, message->status, message->category, message->text);
        message_free(message);
    }
    if (dropped > 0) {
        report(self, 0, STATUS_WARNING, "fmugym", "later messages were dropped: too many at once");
    }
}

static void drain_if_pending(PyPool *self) {
    if (atomic_get(&self->pool.log.pending)) {
        drain(self);
    }
}

static void close_pool(PyPool *self) {
    if (self->open) {
        self->open = false;
        Py_BEGIN_ALLOW_THREADS
        pool_close(&self->pool);
        Py_END_ALLOW_THREADS
        drain_if_pending(self);
        log_close(&self->pool.log);
    }
}

static bool open_pool(PyPool *self) {
    const Settings settings = self->pool.settings;
    char error[2048];
    bool opened;

    self->open = true;
    Py_BEGIN_ALLOW_THREADS
    opened = pool_open(&self->pool, &settings, error, sizeof error);
    Py_END_ALLOW_THREADS
    drain_if_pending(self);
    if (!opened) {
        close_pool(self);
        PyObject *text = decode(error);
        PyErr_SetObject(PyExc_OSError, text);
        Py_XDECREF(text);
    }
    return opened;
}

static PyObject *pool_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) {
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyPool *self = (PyPool *)allocate(type, 0);
    Arguments a;

    (void)kwargs;
    if (self == NULL) {
        return NULL;
    }
    Py_INCREF(args);
    self->arguments = args;
    if (parse(self, args, &a) && check_numbers(&a) &&
        take_paths(self, a.paths, a.private_libraries ? a.count : 1) &&
        take_strings(self, a.strings) && take_arrays(self, &a) && settle(self, &a) &&
        open_pool(self)) {
        return (PyObject *)self;
    }
    Py_DECREF(self);
    return NULL;
}

static void drop_play(PyPool *self) {
    self->can_play = false;
    for (int i = 0; i < PLAY_BUFFERS; i++) {
        release(&self->play_buffers[i]);
        self->play_buffers[i].obj = NULL;
    }
    Py_XDECREF(self->start);
    self->start = NULL;
}

/* The messages of closing go to Python, which must not touch an error that is on its way. */
static void pool_dealloc(PyObject *object) {
    PyPool *self = (PyPool *)object;
    PyObject *type, *value, *traceback;

    PyErr_Fetch(&type, &value, &traceback);
    close_pool(self);
    PyErr_Restore(type, value, traceback);
    for (int i = 0; i < BUFFERS; i++) {
        release(&self->buffers[i]);
    }
    drop_play(self);
    free(self->paths);
    free(self->strings);
    free(self->streams);
    Py_XDECREF(self->generators);
    Py_XDECREF(self->arguments);
    free_object(object);
}

static bool require_open(const PyPool *self) {
    if (!self->open) {
        PyErr_SetString(PyExc_ValueError, "the pool is closed");
    }
    return self->open;
}

/* Calls */

/* The arrays of one call; those that are the pool's own need no new buffer. */
typedef struct {
    Py_buffer inputs, mask, observations, values;
} Views;

static void release_views(Views *views) {
    release(&views->inputs);
    release(&views->mask);
    release(&views->observations);
    release(&views->values);
}

static bool view_inputs(PyPool *self, PyObject *object, Views *views, Call *call) {
    const Settings *s = &self->pool.settings;
    Py_buffer *buffer = &self->buffers[INPUTS];

    if (object != self->arrays[INPUTS] && object != Py_None) {
        buffer = &views->inputs;
        if (!take_buffer(object, buffer, PyBUF_STRIDES, "inputs", "d",
                         (Py_ssize_t)s->inputs->count, (Py_ssize_t)s->count)) {
            return false;
        }
    }
    call->inputs = (Matrix){buffer->buf, buffer->strides[0], buffer->strides[1]};
    return true;
}

static bool view_mask(PyPool *self, PyObject *object, Views *views, Mask *mask) {
    if (object == Py_None) {
        return true;
    }
    if (!take_buffer(object, &views->mask, PyBUF_STRIDES, "the mask", "?", -1,
                     (Py_ssize_t)self->pool.settings.count)) {
        return false;
    }
    *mask = (Mask){views->mask.buf, views->mask.strides[0]};
    return true;
}

static bool view_observations(PyPool *self, PyObject *object, Views *views, Call *call) {
    const Settings *s = &self->pool.settings;
    Py_buffer *buffer = &self->buffers[OBSERVATIONS];

    if (object == Py_None) {
        return true;
    }
    if (object != self->arrays[OBSERVATIONS]) {
        buffer = &views->observations;
        if (!take_buffer(object, buffer, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, "observations", "f",
                         (Py_ssize_t)s->count, (Py_ssize_t)s->num_observed)) {
            return false;
        }
    }
    call->observations = buffer->buf;
    return true;
}

static bool is_access(const PyPool *self, PyObject *object) {
    if (!PyObject_TypeCheck(object, access_type) ||
        ((PyAccess *)object)->access.fmi != self->pool.settings.fmi) {
        PyErr_SetString(PyExc_TypeError, "expected an Access of this FMI version");
        return false;
    }
    return true;
}

static bool view_start(PyPool *self, PyObject *access, PyObject *values, Views *views,
                       Call *call) {
    if (!is_access(self, access)) {
        return false;
    }
    call->start = &((PyAccess *)access)->access;
    if (!take_buffer(values, &views->values, PyBUF_STRIDES, "values", "d",
                     (Py_ssize_t)call->start->count, (Py_ssize_t)self->pool.settings.count)) {
        return false;
    }
    const Py_buffer *buffer = &views->values;
    call->start_values = (Matrix){buffer->buf, buffer->strides[0], buffer->strides[1]};
    return true;
}

/* Work so short that nobody notices is done without letting go of the interpreter: getting it back
 * may take milliseconds where other Python threads are busy. */
static size_t run_call(PyPool *self, int operation, const Call *call) {
    static size_t (*const functions[])(Pool *, const Call *) = {pool_step, pool_reset,
                                                                pool_step_or_reset};
    size_t troubled;

    if (pool_is_quick(&self->pool, operation)) {
        return functions[operation](&self->pool, call);
    }
    Py_BEGIN_ALLOW_THREADS
    troubled = functions[operation](&self->pool, call);
    Py_END_ALLOW_THREADS
    return troubled;
}

static PyObject *finish(PyPool *self, int operation, const Call *call, Views *views) {
    const size_t troubled = run_call(self, operation, call);
    if (views != NULL) {
        release_views(views);
    }
    drain_if_pending(self);
    return PyLong_FromSize_t(troubled);
}

static bool has_arguments(Py_ssize_t given, Py_ssize_t expected) {
    if (given != expected) {
        PyErr_Format(PyExc_TypeError, "expected %zd arguments, got %zd", expected, given);
    }
    return given == expected;
}

static PyObject *step_own(PyObject *object, PyObject *unused) {
    PyPool *self = (PyPool *)object;
    const Py_buffer *inputs = &self->buffers[INPUTS];
    const Call call = {
        .inputs = {inputs->buf, inputs->strides[0], inputs->strides[1]},
        .observations = self->buffers[OBSERVATIONS].buf,
    };

    (void)unused;
    return require_open(self) ? finish(self, STEP, &call, NULL) : NULL;
}

static PyObject *step(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Views views = {.inputs.obj = NULL};
    Call call = {.observations = NULL};

    if (require_open(self) && has_arguments(nargs, 3) &&
        view_inputs(self, args[0], &views, &call) &&
        view_mask(self, args[1], &views, &call.mask) &&
        view_observations(self, args[2], &views, &call)) {
        return finish(self, STEP, &call, &views);
    }
    release_views(&views);
    return NULL;
}

static PyObject *reset(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Views views = {.inputs.obj = NULL};
    Call call = {.observations = NULL};

    if (require_open(self) && has_arguments(nargs, 4) &&
        view_inputs(self, Py_None, &views, &call) &&
        view_start(self, args[0], args[1], &views, &call) &&
        view_mask(self, args[2], &views, &call.mask) &&
        view_observations(self, args[3], &views, &call)) {
        return finish(self, RESET, &call, &views);
    }
    release_views(&views);
    return NULL;
}

static PyObject *step_or_reset(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Views views = {.inputs.obj = NULL};
    Call call = {.observations = NULL};

    if (require_open(self) && has_arguments(nargs, 5) &&
        view_inputs(self, args[0], &views, &call) &&
        view_start(self, args[1], args[2], &views, &call) &&
        view_mask(self, args[3], &views, &call.mask) &&
        view_observations(self, args[4], &views, &call)) {
        return finish(self, MIXED, &call, &views);
    }
    release_views(&views);
    return NULL;
}

/* Playing: see play.h */

typedef struct {
    const char *code, *constants, *results;
    Py_ssize_t code_size, constants_size, results_size;
} ProgramBytes;

static bool take_program(const ProgramBytes *bytes, Program *program) {
    program->length = (size_t)bytes->code_size / sizeof(Instruction);
    program->number_of_constants = (size_t)bytes->constants_size / sizeof(double);
    program->number_of_results = (size_t)bytes->results_size / sizeof(uint16_t);
    if (program->length < 1 || program->length > PROGRAM_LENGTH ||
        program->number_of_constants > PROGRAM_LENGTH ||
        program->number_of_results > PROGRAM_RESULTS) {
        PyErr_SetString(PyExc_ValueError, "a program is too long");
        return false;
    }
    memcpy(program->code, bytes->code, (size_t)bytes->code_size);
    memcpy(program->constants, bytes->constants, (size_t)bytes->constants_size);
    memcpy(program->results, bytes->results, (size_t)bytes->results_size);
    return true;
}

static bool take_play_arrays(PyPool *self, PyObject *const *arrays, Py_ssize_t draws,
                             Py_ssize_t episodes) {
    static const char *const formats[PLAY_BUFFERS] = {"d", "d", "lq", "d", "d", "lq", "lq", "?"};
    const Py_ssize_t n = (Py_ssize_t)self->pool.settings.count;
    const Py_ssize_t starts = (Py_ssize_t)((PyAccess *)self->start)->access.count;
    const Py_ssize_t rows[PLAY_BUFFERS] = {starts, -1, -1, -1, -1, -1, -1, -1};
    const Py_ssize_t columns[PLAY_BUFFERS] = {n, n * draws * episodes, n, draws, draws, draws,
                                              n, n};

    for (int i = 0; i < PLAY_BUFFERS; i++) {
        if (!take_buffer(arrays[i], &self->play_buffers[i], PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE,
                         "an array of play", formats[i], rows[i], columns[i])) {
            return false;
        }
    }
    return true;
}

static void settle_play(PyPool *self, Py_ssize_t draws, Py_ssize_t episodes) {
    const Py_buffer *b = self->play_buffers;
    const Settings *s = &self->pool.settings;
    Play *play = &self->play;

    play->count = s->count;
    play->input_rows = self->buffers[INPUTS].buf;
    play->start_values = b[STARTS].buf;
    play->draws = (Draws){self->streams, (size_t)draws, (size_t)episodes, b[BLOCK].buf,
                          b[USED].buf,   b[LOW].buf,    b[WIDTH].buf,     b[ROWS].buf};
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
        .number_of_parameters = ((PyAccess *)self->start)->access.count,
    };
}

static bool play_is_sound(const PyPool *self) {
    const Play *play = &self->play;
    bool sound = program_is_sound(&play->inputs, &play->source) &&
                 program_is_sound(&play->judgement, &play->source) &&
                 play->inputs.number_of_results == play->source.number_of_inputs &&
                 play->judgement.number_of_results == 3;

    for (size_t i = 0; i < play->draws.draws; i++) {
        const int64_t row = play->draws.rows[i];
        sound = sound && row >= 0 && (size_t)row < play->source.number_of_parameters;
    }
    if (!sound) {
        PyErr_SetString(PyExc_ValueError, "a program does not fit the pool");
    }
    return sound;
}

static PyObject *prepare_play(PyObject *object, PyObject *args) {
    PyPool *self = (PyPool *)object;
    ProgramBytes in, judge;
    PyObject *start, *arrays[PLAY_BUFFERS];
    Py_ssize_t draws, episodes;
    long long lowest, highest, limit;

    if (!PyArg_ParseTuple(args, "O(y#y#y#)(y#y#y#)LLLnnOOOOOOOO", &start, &in.code, &in.code_size,
                          &in.constants, &in.constants_size, &in.results, &in.results_size,
                          &judge.code, &judge.code_size, &judge.constants, &judge.constants_size,
                          &judge.results, &judge.results_size, &lowest, &highest, &limit, &draws,
                          &episodes, &arrays[STARTS], &arrays[BLOCK], &arrays[USED], &arrays[LOW],
                          &arrays[WIDTH], &arrays[ROWS], &arrays[COUNTS], &arrays[ENDED]) ||
        !is_access(self, start)) {
        return NULL;
    }
    drop_play(self);
    Py_INCREF(start);
    self->start = start;
    self->play.lowest_action = lowest;
    self->play.highest_action = highest;
    self->play.limit = limit;
    if (!take_program(&in, &self->play.inputs) || !take_program(&judge, &self->play.judgement) ||
        !take_play_arrays(self, arrays, draws, episodes)) {
        return NULL;
    }
    settle_play(self, draws, episodes);
    if (!play_is_sound(self)) {
        return NULL;
    }
    self->can_play = true;
    Py_RETURN_NONE;
}

static const Stream *stream_of(PyObject *generator) {
    PyObject *capsule = PyObject_GetAttrString(generator, "capsule");
    const Stream *stream = capsule == NULL ? NULL : PyCapsule_GetPointer(capsule, "BitGenerator");
    Py_XDECREF(capsule); /* the generator has it */
    return stream;
}

static PyObject *set_streams(PyObject *object, PyObject *generators) {
    PyPool *self = (PyPool *)object;
    const size_t count = self->pool.settings.count;
    PyObject *kept = PySequence_Tuple(generators);
    const Stream **streams = malloc(count * sizeof *streams);
    bool good = kept != NULL && streams != NULL;

    if (good && PyTuple_Size(kept) != (Py_ssize_t)count) {
        PyErr_SetString(PyExc_ValueError, "there must be a bit generator for each instance");
        good = false;
    }
    for (size_t i = 0; i < count && good; i++) {
        streams[i] = stream_of(PyTuple_GetItem(kept, (Py_ssize_t)i));
        good = streams[i] != NULL;
    }
    if (!good) {
        free(streams);
        Py_XDECREF(kept);
        return PyErr_Occurred() ? NULL : PyErr_NoMemory();
    }
    free(self->streams);
    Py_XDECREF(self->generators);
    self->generators = kept;
    self->play.draws.streams = self->streams = streams;
    Py_RETURN_NONE;
}

static bool require_play(const PyPool *self) {
    const bool ready = self->can_play && (self->streams != NULL || self->play.draws.draws == 0);
    if (!ready) {
        PyErr_SetString(PyExc_ValueError, "play was not prepared, or has no streams");
    }
    return ready;
}

enum { ACTIONS, SEEN, REWARDS, TERMINATED, TRUNCATED, DRAWN, TURN_BUFFERS };

static bool take_turn(PyPool *self, PyObject *const *args, Py_buffer *buffers) {
    static const char *const formats[TURN_BUFFERS] = {"lq", "f", "d", "?", "?", "d"};
    const Settings *s = &self->pool.settings;
    const Py_ssize_t n = (Py_ssize_t)s->count;
    const Py_ssize_t draws = (Py_ssize_t)self->play.draws.draws;
    const Py_ssize_t rows[TURN_BUFFERS] = {-1, n, -1, -1, -1, draws};
    const Py_ssize_t columns[TURN_BUFFERS] = {n, (Py_ssize_t)s->num_observed, n, n, n, n};

    for (int i = 0; i < TURN_BUFFERS; i++) {
        const int flags = PyBUF_C_CONTIGUOUS | (i == ACTIONS ? 0 : PyBUF_WRITABLE);
        if (!take_buffer(args[i], &buffers[i], flags, "an array of play", formats[i], rows[i],
                         columns[i])) {
            return false;
        }
    }
    return true;
}

static size_t run_play(PyPool *self, const Call *call, size_t *ended) {
    size_t troubled;

    if (pool_is_quick(&self->pool, PLAY)) {
        return pool_play(&self->pool, call, ended);
    }
    Py_BEGIN_ALLOW_THREADS
    troubled = pool_play(&self->pool, call, ended);
    Py_END_ALLOW_THREADS
    return troubled;
}

static PyObject *play_turn(PyPool *self, const Py_buffer *buffers) {
    const Py_buffer *inputs = &self->buffers[INPUTS], *starts = &self->play_buffers[STARTS];
    const Turn turn = {&self->play, buffers[ACTIONS].buf, buffers[REWARDS].buf,
                       buffers[TERMINATED].buf, buffers[TRUNCATED].buf, buffers[DRAWN].buf};
    const Call call = {
        .inputs = {inputs->buf, inputs->strides[0], inputs->strides[1]},
        .start = &((PyAccess *)self->start)->access,
        .start_values = {starts->buf, starts->strides[0], starts->strides[1]},
        .mask = {(const char *)self->play.ended, 1},
        .observations = buffers[SEEN].buf,
        .turn = &turn,
    };
    size_t ended = 0;

    if (play_has_bad_action(&turn)) {
        PyErr_SetString(PyExc_ValueError, "an action is out of range");
        return NULL;
    }
    const size_t troubled = run_play(self, &call, &ended);
    drain_if_pending(self);
    return Py_BuildValue("(nn)", (Py_ssize_t)troubled, (Py_ssize_t)ended);
}

static PyObject *play(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Py_buffer buffers[TURN_BUFFERS] = {{.obj = NULL}};
    PyObject *result = NULL;

    if (require_open(self) && has_arguments(nargs, TURN_BUFFERS) && require_play(self) &&
        take_turn(self, args, buffers)) {
        result = play_turn(self, buffers);
    }
    for (int i = 0; i < TURN_BUFFERS; i++) {
        release(&buffers[i]);
    }
    return result;
}

static PyObject *save(PyObject *object, PyObject *unused) {
    PyPool *self = (PyPool *)object;
    allocfunc allocate = (allocfunc)PyType_GetSlot(snapshot_type, Py_tp_alloc);
    ptrdiff_t failed;

    (void)unused;
    if (!require_open(self)) {
        return NULL;
    }
    PySnapshot *made = (PySnapshot *)allocate(snapshot_type, 0);
    if (made == NULL) {
        return NULL;
    }
    if (!snapshot_open(&made->snapshot, self->pool.settings.count)) {
        Py_DECREF(made);
        return PyErr_NoMemory();
    }
    Py_INCREF(object);
    made->pool = object;
    Py_BEGIN_ALLOW_THREADS
    failed = pool_save(&self->pool, &made->snapshot);
    Py_END_ALLOW_THREADS
    drain_if_pending(self);
    if (failed >= 0) {
        Py_DECREF(made);
        return PyLong_FromSsize_t(failed);
    }
    return (PyObject *)made;
}

static bool is_own_snapshot(PyPool *self, PyObject *object, Mask mask) {
    if (!PyObject_TypeCheck(object, snapshot_type) ||
        ((PySnapshot *)object)->pool != (PyObject *)self) {
        PyErr_SetString(PyExc_ValueError, "the snapshot was taken from another pool");
        return false;
    }
    if (pool_find_foreign(&self->pool, &((PySnapshot *)object)->snapshot, mask) >= 0) {
        PyErr_SetString(PyExc_ValueError, "the snapshot is of another instance than this one");
        return false;
    }
    return true;
}

static PyObject *restore(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Views views = {.inputs.obj = NULL};
    Mask mask = {NULL, 0};
    size_t troubled;

    if (!require_open(self) || !has_arguments(nargs, 2) ||
        !view_mask(self, args[1], &views, &mask) || !is_own_snapshot(self, args[0], mask)) {
        release_views(&views);
        return NULL;
    }
    Py_BEGIN_ALLOW_THREADS
    troubled = pool_restore(&self->pool, &((PySnapshot *)args[0])->snapshot, mask);
    Py_END_ALLOW_THREADS
    release_views(&views);
    drain_if_pending(self);
    return PyLong_FromSize_t(troubled);
}

static PyObject *read_variables(PyObject *object, PyObject *const *args, Py_ssize_t nargs) {
    PyPool *self = (PyPool *)object;
    Py_buffer values;
    ptrdiff_t failed;

    if (!require_open(self) || !has_arguments(nargs, 2) || !is_access(self, args[0])) {
        return NULL;
    }
    const Access *access = &((PyAccess *)args[0])->access;
    if (!take_buffer(args[1], &values, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE, "values", "d",
                     (Py_ssize_t)access->count, (Py_ssize_t)self->pool.settings.count)) {
        return NULL;
    }
    Py_BEGIN_ALLOW_THREADS
    failed = pool_read(&self->pool, access, values.buf);
    Py_END_ALLOW_THREADS
    PyBuffer_Release(&values);
    drain_if_pending(self);
    return PyLong_FromSsize_t(failed);
}

static PyObject *values_of(const Failure *f) {
    if (f->values == NULL) {
        Py_RETURN_NONE;
    }
    return PyBytes_FromStringAndSize((const char *)f->values,
                                     (Py_ssize_t)(f->number_of_values * sizeof *f->values));
}

static PyObject *failure(PyObject *object, PyObject *argument) {
    PyPool *self = (PyPool *)object;
    const Py_ssize_t index = PyNumber_AsSsize_t(argument, PyExc_IndexError);

    if (PyErr_Occurred() || !require_open(self)) {
        return NULL;
    }
    if (index < 0 || (size_t)index >= self->pool.settings.count) {
        PyErr_SetString(PyExc_IndexError, "there is no such instance");
        return NULL;
    }
    Failure f;
    if (!pool_failure(&self->pool, (size_t)index, &f)) {
        Py_RETURN_NONE;
    }
    PyObject *result = Py_BuildValue("sOidINN", f.doing, f.in_warm_up ? Py_True : Py_False,
                                     f.status, f.time, (unsigned)f.string_reference,
                                     decode(f.said), values_of(&f));
    free(f.said);
    free(f.values);
    return result;
}

static PyObject *close_method(PyObject *object, PyObject *unused) {
    (void)unused;
    close_pool((PyPool *)object);
    Py_RETURN_NONE;
}

static PyObject *count_steps(PyObject *object, PyObject *unused) {
    PyPool *self = (PyPool *)object;

    (void)unused;
    if (!require_open(self)) {
        return NULL;
    }
    Py_BEGIN_ALLOW_THREADS
    pool_count_steps(&self->pool);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyObject *recycle(PyObject *object, PyObject *unused) {
    PyPool *self = (PyPool *)object;

    (void)unused;
    if (!require_open(self)) {
        return NULL;
    }
    Py_BEGIN_ALLOW_THREADS
    pool_recycle(&self->pool);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

/* For tests and benchmarks. */
static PyObject *costs(PyObject *object, PyObject *unused) {
    const Cost *c = ((PyPool *)object)->pool.costs;
    (void)unused;
    return Py_BuildValue("(ddd)", c[STEP].mean, c[RESET].mean, c[MIXED].mean);
}

static PyObject *uses_states(PyObject *object, PyObject *unused) {
    PyPool *self = (PyPool *)object;
    (void)unused;
    return PyBool_FromLong(self->pool.settings.can_save &&
                           self->pool.settings.reset_method == RESET_BY_RESTORE &&
                               !atomic_get(&self->pool.states_too_large));
}

/* The memory of the echo, which is the process's. */
static Py_buffer echo;

static PyObject *echo_to(PyObject *module, PyObject *memory) {
    Py_buffer view;

    (void)module;
    if (PyObject_GetBuffer(memory, &view, PyBUF_SIMPLE | PyBUF_WRITABLE) < 0) {
        return NULL;
    }
    log_echo_to(view.buf, (size_t)view.len);
    release(&echo);
    echo = view;
    Py_RETURN_NONE;
}

/* The module */

#define FAST(name, function) {name, (PyCFunction)(void (*)(void))function, METH_FASTCALL, NULL}

static PyMethodDef pool_methods[] = {
    {"step_own", step_own, METH_NOARGS, NULL},
    FAST("step", step),
    FAST("reset", reset),
    FAST("step_or_reset", step_or_reset),
    {"prepare_play", prepare_play, METH_VARARGS, NULL},
    {"set_streams", set_streams, METH_O, NULL},
    FAST("play", play),
    {"save", save, METH_NOARGS, NULL},
    FAST("restore", restore),
    FAST("read", read_variables),
    {"failure", failure, METH_O, NULL},
    {"count_steps", count_steps, METH_NOARGS, NULL},
    {"recycle", recycle, METH_NOARGS, NULL},
    {"close", close_method, METH_NOARGS, NULL},
    {"costs", costs, METH_NOARGS, NULL},
    {"uses_states", uses_states, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot access_slots[] = {
    {Py_tp_new, (void *)access_new},
    {Py_tp_dealloc, (void *)access_dealloc},
    {0, NULL},
};
static PyType_Slot pool_slots[] = {
    {Py_tp_new, (void *)pool_new},
    {Py_tp_dealloc, (void *)pool_dealloc},
    {Py_tp_methods, pool_methods},
    {0, NULL},
};
static PyType_Slot snapshot_slots[] = {
    {Py_tp_dealloc, (void *)snapshot_dealloc},
    {0, NULL},
};

static PyType_Spec access_spec = {"fmugym._native.Access", sizeof(PyAccess), 0,
                                  Py_TPFLAGS_DEFAULT, access_slots};
static PyType_Spec pool_spec = {"fmugym._native.Pool", sizeof(PyPool), 0, Py_TPFLAGS_DEFAULT,
                                pool_slots};
static PyType_Spec snapshot_spec = {"fmugym._native.Snapshot", sizeof(PySnapshot), 0,
                                    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION,
                                    snapshot_slots};

static bool add_type(PyObject *module, PyTypeObject **type, PyType_Spec *spec) {
    *type = (PyTypeObject *)PyType_FromSpec(spec);
    return *type != NULL && PyModule_AddType(module, *type) == 0;
}

static PyMethodDef module_functions[] = {
    {"echo_to", echo_to, METH_O, NULL},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    .m_base = PyModuleDef_HEAD_INIT,
    .m_name = "fmugym._native",
    .m_doc = "Pools of FMU instances in C.",
    .m_size = -1,
    .m_methods = module_functions,
};

PyMODINIT_FUNC PyInit__native(void) {
    PyObject *module = PyModule_Create(&definition);

    if (module == NULL) {
        return NULL;
    }
    pool_prepare_process();
    if (!add_type(module, &access_type, &access_spec) ||
        !add_type(module, &pool_type, &pool_spec) ||
        !add_type(module, &snapshot_type, &snapshot_spec)) {
        Py_DECREF(module);
        return NULL;
    }
    return module;
}
