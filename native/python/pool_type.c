/* The type Pool: making, closing and entering pools, and reporting the messages of their FMUs. */

#include <stdlib.h>
#include <string.h>

#include "python.h"

PyObject *decode(const char *text) {
    return PyUnicode_DecodeUTF8(text == NULL ? "" : text,
                                text == NULL ? 0 : (Py_ssize_t)strlen(text), "replace");
}

/* Messages go to Python after a call, on the thread that made the call. */

/* The caller gets what the receiver raises: it may come from a signal handler that ran in it. */
static bool report(PyPool *self, const Message *message) {
    PyObject *result =
        PyObject_CallFunction(self->callback, "niNN", (Py_ssize_t)message->index, message->status,
                              decode(message->category), decode(message->text));

    Py_XDECREF(result);
    return result != NULL;
}

static bool report_dropped(PyPool *self) {
    static char category[] = "fmugym", text[] = "later messages were dropped: too many at once";
    const Message message = {.status = STATUS_WARNING, .category = category, .text = text};
    return report(self, &message);
}

/* If an exception interrupts this, the next call reports the remaining messages. */
static bool drain(PyPool *self) {
    size_t dropped;
    Message *left = log_take(&self->pool.log, &dropped);
    bool good = true;

    while (good && left != NULL) {
        Message *message = left;
        left = message->next;
        good = report(self, message);
        message_free(message);
    }
    if (good && dropped > 0) {
        dropped = 0;
        good = report_dropped(self);
    }
    if (left != NULL || dropped > 0) {
        log_give_back(&self->pool.log, left, dropped);
    }
    return good;
}

/* The recording of an episode goes to Python likewise. */

static void do_take_tape(PyPool *self, bool alone, void *context) {
    Tape *taken = context;
    (void)alone;
    *taken = self->pool.tape;
    memset(&self->pool.tape, 0, sizeof self->pool.tape);
}

static PyObject *tape_as_tuple(const Tape *t) {
    const Py_ssize_t starts = (Py_ssize_t)t->number_of_starts, rows = (Py_ssize_t)t->rows;
    const Py_ssize_t in = (Py_ssize_t)t->width_in, out = (Py_ssize_t)t->width_out;
    const Py_ssize_t number = sizeof(double);

    return Py_BuildValue("y#y#y#y#y#y#y#", (const char *)t->start_types, starts,
                         (const char *)t->start_variables, starts * (Py_ssize_t)sizeof(Element),
                         (const char *)t->starts, starts * number, (const char *)t->first_outputs,
                         out * number, (const char *)t->inputs, rows * in * number,
                         (const char *)t->outputs, rows * out * number, (const char *)t->statuses,
                         rows);
}

static bool hand_over_tape(PyPool *self) {
    Tape taken = {0};

    if (!perform(self, ALWAYS_SHORT, do_take_tape, &taken)) {
        return false;
    }
    PyObject *tuple = taken.state == TAPE_READY ? tape_as_tuple(&taken) : Py_NewRef(Py_None);
    PyObject *result = NULL;
    tape_free(&taken);
    if (tuple != NULL && tuple != Py_None) {
        result = PyObject_CallFunctionObjArgs(self->listener, tuple, NULL);
    } else if (tuple == Py_None) {
        result = Py_NewRef(Py_None);
    }
    Py_XDECREF(tuple);
    Py_XDECREF(result);
    return result != NULL;
}

bool report_messages(PyPool *self) {
    const bool reported = !atomic_get(&self->pool.log.pending) || drain(self);
    return reported && (!atomic_get(&self->pool.tape.ready) || hand_over_tape(self));
}

/* Entering */

/* Getting the GIL back may take milliseconds if other Python threads are busy. So very short
 * work keeps the GIL. */
static bool is_short(const PyPool *self, int length) {
    return length == ALWAYS_SHORT || (length >= 0 && pool_is_quick(&self->pool, length));
}

static bool explain(Entry entry) {
    if (entry == ENTRY_CLOSED) {
        PyErr_SetString(closed_error, "the pool is closed");
    } else if (entry == ENTRY_INSIDE) {
        PyErr_SetString(PyExc_RuntimeError, "an FMU has called the pool that it is in");
    }
    return entry == ENTRY_ENTERED;
}

bool perform(PyPool *self, int length, Work *work, void *context) {
    Entry entry = pool_try_enter(&self->pool);

    if (entry == ENTRY_ENTERED && is_short(self, length)) {
        work(self, true, context);
        pool_leave(&self->pool);
    } else if (entry == ENTRY_ENTERED || entry == ENTRY_BUSY) {
        Py_BEGIN_ALLOW_THREADS entry = entry == ENTRY_BUSY ? pool_enter(&self->pool) : entry;
        if (entry == ENTRY_ENTERED) {
            work(self, false, context);
            pool_leave(&self->pool);
        }
        Py_END_ALLOW_THREADS
    }
    return explain(entry);
}

/* Closing */

/* Returns false with an exception if reporting the last messages was interrupted, or if an FMU
 * closes its own pool. */
static bool close_pool(PyPool *self) {
    Entry entry;

    Py_BEGIN_ALLOW_THREADS entry = pool_enter(&self->pool);
    if (entry == ENTRY_ENTERED) {
        pool_close(&self->pool);
        pool_leave(&self->pool);
    }
    Py_END_ALLOW_THREADS if (entry != ENTRY_ENTERED) {
        return entry == ENTRY_CLOSED || explain(entry);
    }
    const bool reported = report_messages(self);
    log_close(&self->pool.log);
    return reported;
}

PyObject *py_close(PyObject *object, PyObject *unused) {
    (void)unused;
    if (!close_pool((PyPool *)object)) {
        return NULL;
    }
    Py_RETURN_NONE;
}

/* An exception may already be set when this is called. This function cannot raise another one. */
static void close_at_the_end(PyPool *self) {
    PyObject *type, *value, *traceback;

    PyErr_Fetch(&type, &value, &traceback);
    if (!close_pool(self)) {
        PyErr_WriteUnraisable(NULL);
    }
    pool_dispose(&self->pool);
    PyErr_Restore(type, value, traceback);
}

static void pool_dealloc(PyObject *object) {
    PyPool *self = (PyPool *)object;
    PyTypeObject *type = Py_TYPE(object);
    freefunc release_memory = (freefunc)PyType_GetSlot(type, Py_tp_free);

    if (self->opened) {
        close_at_the_end(self);
    }
    for (int i = 0; i < BUFFERS; i++) {
        release_buffer(&self->buffers[i]);
    }
    drop_system(self->system);
    free(self->paths);
    free(self->categories);
    Py_XDECREF(self->playing);
    Py_XDECREF(self->single);
    Py_XDECREF(self->actions[0]);
    Py_XDECREF(self->actions[1]);
    Py_XDECREF(self->arguments);
    release_memory(object);
    Py_DECREF(type);
}

/* Making a pool. Each argument is a dict of named values. */

typedef struct {
    PyObject *paths, *categories, *mark, *solving, *system, *stop_time, *tolerance;
    PyAccess *inputs, *outputs;
    Py_ssize_t size_of_references, size_of_values; /* of structural parameters */
    Py_ssize_t num_observed, count, threads, start_outputs_size;
    int version, manner, private_libraries, logging, can_save;
    int restores, rebuilds, reloads, one_initialization;
    long long substeps, warm_up_steps, retries;
    const char *sampling;
    Py_ssize_t samplings;
    double pace;
} Arguments;

bool parse_group(PyObject *group, const char *format, char **names, ...) {
    PyObject *nothing = PyTuple_New(0);
    va_list places;

    va_start(places, names);
    const bool parsed =
        nothing != NULL && PyArg_VaParseTupleAndKeywords(nothing, group, format, names, places);
    va_end(places);
    Py_XDECREF(nothing);
    return parsed;
}

static bool parse_library(PyPool *self, PyObject *group, Arguments *a) {
    static char *names[] = {"version", "manner",  "model",  "token",      "resources", "paths",
                            "private", "logging", "states", "categories", "mark", "solving", "system",
                            "structural_references", "structural_values", NULL};
    Settings *s = &self->pool.settings;
    return parse_group(group, "$iiyyyO!pppO!OOOy#y#:library", names, &a->version, &a->manner, &s->model,
                       &s->token, &s->resources, &PyTuple_Type, &a->paths, &a->private_libraries, &a->logging,
                       &a->can_save, &PyTuple_Type, &a->categories, &a->mark, &a->solving, &a->system,
                       &s->experiment.structural_references, &a->size_of_references,
                       &s->experiment.structural_values, &a->size_of_values);
}

static bool parse_experiment(PyPool *self, PyObject *group, Arguments *a) {
    static char *names[] = {"start_time", "stop_time",     "tolerance", "time_step",
                            "substeps",   "warm_up_steps", "retries",   "restores",
                            "rebuilds",   "reloads",       "one_initialization",
                            "pace",       "start_outputs", NULL};
    Settings *s = &self->pool.settings;
    return parse_group(group, "$dOOdLLLppppdz#:experiment", names, &s->experiment.start_time,
                       &a->stop_time, &a->tolerance, &s->time_step, &a->substeps, &a->warm_up_steps,
                       &a->retries, &a->restores, &a->rebuilds, &a->reloads,
                       &a->one_initialization, &a->pace, &s->start_outputs,
                       &a->start_outputs_size);
}

static bool parse_variables(PyObject *group, Arguments *a) {
    static char *names[] = {"inputs", "outputs", "num_observed", "sampling", NULL};
    return parse_group(group, "$O!O!ny#:variables", names, access_type, &a->inputs, access_type,
                       &a->outputs, &a->num_observed, &a->sampling, &a->samplings);
}

static bool parse_arrays(PyPool *self, PyObject *group) {
    static char *names[] = {"inputs",       "outputs", "statuses",
                            "observations", "health",  "last_initialization", NULL};
    PyObject **arrays = self->arrays;
    return parse_group(group, "$OOOOOO:arrays", names, &arrays[INPUTS], &arrays[OUTPUTS],
                       &arrays[STATUS], &arrays[OBSERVATIONS], &arrays[HEALTH],
                       &arrays[LAST_INITIALIZATION]);
}

static bool parse(PyPool *self, PyObject *args, PyObject *kwargs, Arguments *a) {
    static char *names[] = {"library", "experiment", "variables", "arrays",
                            "count",   "threads",    "callback",  "listener", NULL};
    PyObject *library, *experiment, *variables, *arrays;

    return PyArg_ParseTupleAndKeywords(args, kwargs, "$O!O!O!O!nnOO:Pool", names, &PyDict_Type,
                                       &library, &PyDict_Type, &experiment, &PyDict_Type,
                                       &variables, &PyDict_Type, &arrays, &a->count, &a->threads,
                                       &self->callback, &self->listener) &&
           parse_library(self, library, a) && parse_experiment(self, experiment, a) &&
           parse_variables(variables, a) && parse_arrays(self, arrays);
}

static bool check_numbers(const Arguments *a) {
    const bool sound = a->count >= 1 && a->count <= INT32_MAX && a->threads >= 1 &&
                       a->substeps >= 1 && a->warm_up_steps >= 0 && a->num_observed >= 0 &&
                       a->retries >= 0 && a->retries < 31 && (a->retries == 0 || a->can_save) &&
                       (size_t)a->num_observed <= a->outputs->access.count &&
                       (a->samplings == 0 || (size_t)a->samplings == a->outputs->access.count);
    if (!sound) {
        PyErr_SetString(PyExc_ValueError, "a number is out of range");
    }
    return sound;
}

static bool check_start_outputs(const PyPool *self, const Arguments *a) {
    const size_t wanted = a->outputs->access.count * sizeof(double);
    const bool sound =
        self->pool.settings.start_outputs == NULL || (size_t)a->start_outputs_size == wanted;

    if (!sound) {
        PyErr_Format(PyExc_ValueError, "%zu bytes of start outputs are wanted, not %zd", wanted,
                     a->start_outputs_size);
    }
    return sound;
}

static bool check_accesses(const Arguments *a) {
    const Fmi *fmi = fmi_of(a->version, a->manner);

    if (fmi == NULL) {
        return false;
    }
    if (a->inputs->access.fmi != fmi || a->outputs->access.fmi != fmi) {
        PyErr_SetString(PyExc_TypeError, "expected an Access of this FMI version");
        return false;
    }
    return true;
}

static bool take_optional(PyObject *object, bool *given, double *value) {
    *given = object != Py_None;
    *value = *given ? PyFloat_AsDouble(object) : 0.0;
    return !PyErr_Occurred();
}

const char **take_texts(PyObject *tuple) {
    const Py_ssize_t count = PyTuple_Size(tuple);
    const char **texts = calloc((size_t)count + 1, sizeof *texts);

    if (texts == NULL) {
        PyErr_NoMemory();
    }
    for (Py_ssize_t i = 0; i < count && texts != NULL; i++) {
        texts[i] = PyBytes_AsString(PyTuple_GetItem(tuple, i));
        if (texts[i] == NULL) {
            free(texts);
            return NULL;
        }
    }
    return texts;
}

static bool take_categories(PyPool *self, PyObject *categories) {
    self->categories = take_texts(categories);
    return self->categories != NULL;
}

static bool take_paths(PyPool *self, PyObject *paths, Py_ssize_t wanted) {
    const Py_ssize_t count = PyTuple_Size(paths);

    self->paths = take_texts(paths);
    if (self->paths == NULL) {
        return false;
    }
    if (count == 0) {
        self->pool.settings.elsewhere = true;
        return true;
    }
    if (count != wanted) {
        PyErr_Format(PyExc_ValueError, "%zd libraries are wanted, not %zd", wanted, count);
    }
    return count == wanted;
}

static bool take_method(const char *name, Solving *solving) {
    solving->method = method_of(name);
    if (solving->method == NULL) {
        PyErr_Format(PyExc_ValueError, "there is no solver %s", name);
    }
    return solving->method != NULL;
}

/* The references stay in the pool's arguments. */
bool take_solving(PyObject *tuple, Solving *solving) {
    const char *method, *states, *rates, *clocks, *clocked, *ramps;
    Py_ssize_t count, indicators, states_size, rates_size, clocks_size, clocked_size, ramps_size;
    int completes;

    if (tuple == Py_None) {
        return true;
    }
    if (!PyArg_ParseTuple(tuple, "yddnnpz#z#y#y#y#d", &method, &solving->tolerance,
                          &solving->max_step, &count, &indicators, &completes, &states,
                          &states_size, &rates, &rates_size, &clocks, &clocks_size, &clocked,
                          &clocked_size, &ramps, &ramps_size, &solving->ramp_duration)) {
        return false;
    }
    const Py_ssize_t wanted = count * (Py_ssize_t)sizeof(uint32_t);
    const bool sound = states == NULL || (states_size == wanted && rates_size == wanted);
    if (count < 0 || indicators < 0 || !sound || !(solving->tolerance > 0.0)) {
        PyErr_SetString(PyExc_ValueError, "a number of the solver is out of range");
        return false;
    }
    solving->states = (size_t)count;
    solving->indicators = (size_t)indicators;
    solving->completes = completes;
    solving->state_references = (const uint32_t *)(const void *)states;
    solving->rate_references = (const uint32_t *)(const void *)rates;
    solving->clocks = (const Clock *)(const void *)clocks;
    solving->number_of_clocks = (size_t)clocks_size / sizeof(Clock);
    solving->clocked = (const Clocked *)(const void *)clocked;
    solving->number_of_clocked = (size_t)clocked_size / sizeof(Clocked);
    solving->ramped_references = (const uint32_t *)(const void *)ramps;
    solving->number_of_ramps = (size_t)ramps_size / sizeof(uint32_t);
    return take_method(method, solving);
}

static bool take_arrays(PyPool *self, const Arguments *a) {
    PyObject *const *arrays = self->arrays;
    Py_buffer *buffers = self->buffers;
    const Py_ssize_t n = a->count;
    const Py_ssize_t in = (Py_ssize_t)a->inputs->access.count;
    const Py_ssize_t out = (Py_ssize_t)a->outputs->access.count;

    return take_matrix(arrays[INPUTS], &buffers[INPUTS], WRITTEN, "inputs", ITEM_FLOAT64, in, n) &&
           take_matrix(arrays[OUTPUTS], &buffers[OUTPUTS], WRITTEN, "outputs", ITEM_FLOAT64, out,
                       n) &&
           take_vector(arrays[STATUS], &buffers[STATUS], WRITTEN, "statuses", ITEM_INT8, n) &&
           take_matrix(arrays[OBSERVATIONS], &buffers[OBSERVATIONS], WRITTEN, "observations",
                       ITEM_FLOAT32, n, a->num_observed) &&
           take_matrix(arrays[HEALTH], &buffers[HEALTH], WRITTEN, "health", ITEM_INT64, n,
                       HEALTH_COUNTS) &&
           take_vector(arrays[LAST_INITIALIZATION], &buffers[LAST_INITIALIZATION], WRITTEN,
                       "last_initialization", ITEM_INT64, 1);
}

static bool settle(PyPool *self, const Arguments *a) {
    Settings *s = &self->pool.settings;

    s->fmi = fmi_of(a->version, a->manner);
    s->experiment.number_of_structural = (size_t)a->size_of_values / sizeof(uint64_t);
    s->system = self->system;
    s->private_libraries = a->private_libraries;
    s->logging = a->logging;
    s->can_save = a->can_save && s->fmi->get_state != NULL;
    s->substeps = a->substeps;
    s->warm_up_steps = a->warm_up_steps;
    s->retries = s->can_save ? a->retries : 0;
    s->restores = s->can_save && a->restores;
    s->rebuilds = a->rebuilds;
    s->reloads = a->reloads;
    s->renews = self->system != NULL && self->system->renews;
    s->returns = self->system != NULL && self->system->restores;
    s->one_initialization = a->one_initialization;
    s->inputs = &a->inputs->access;
    s->outputs = &a->outputs->access;
    s->sampling = a->samplings == 0 ? NULL : (const unsigned char *)a->sampling;
    s->num_observed = (size_t)a->num_observed;
    s->count = (size_t)a->count;
    s->threads = (size_t)a->threads;
    s->paths = self->paths;
    s->categories = self->categories;
    s->number_of_categories = (size_t)PyTuple_Size(a->categories);
    s->output_values = self->buffers[OUTPUTS].buf;
    s->status = self->buffers[STATUS].buf;
    s->health = self->buffers[HEALTH].buf;
    if (self->system != NULL) {
        self->system->private_libraries = s->private_libraries;
        self->system->largest_state = STATES_LIMIT / s->count;
    }
    s->pace.interval = (uint64_t)(a->pace * 1e9);
    s->pace.last = self->buffers[LAST_INITIALIZATION].buf;
    return take_mark(a->mark, &s->mark) && take_solving(a->solving, &s->solving) &&
           take_optional(a->stop_time, &s->experiment.has_stop_time, &s->experiment.stop_time) &&
           take_optional(a->tolerance, &s->experiment.has_tolerance, &s->experiment.tolerance);
}

static bool open_pool(PyPool *self) {
    const Settings settings = self->pool.settings;
    char error[8192];
    bool opened;

    self->opened = true;
    Py_BEGIN_ALLOW_THREADS opened = pool_open(&self->pool, &settings, error, sizeof error);
    Py_END_ALLOW_THREADS if (!report_messages(self)) {
        return false;
    }
    if (!opened) {
        PyObject *text = decode(error);
        PyErr_SetObject(PyExc_OSError, text);
        Py_XDECREF(text);
    }
    return opened;
}

/* Copies the dicts, so that nobody can remove what the settings point to. */
static PyObject *copy_of_groups(PyObject *kwargs) {
    PyObject *copy = PyDict_New(), *name, *group;
    Py_ssize_t place = 0;

    while (copy != NULL && kwargs != NULL && PyDict_Next(kwargs, &place, &name, &group)) {
        PyObject *value = PyDict_Check(group) ? PyDict_Copy(group) : Py_NewRef(group);
        if (value == NULL || PyDict_SetItem(copy, name, value) < 0) {
            Py_CLEAR(copy);
        }
        Py_XDECREF(value);
    }
    return copy;
}

static bool check_system(const PyPool *self, const Arguments *a) {
    const bool sound = (a->version == 0) == (self->system != NULL);
    if (!sound) {
        PyErr_SetString(PyExc_ValueError, "version 0 is that of systems");
    }
    return sound;
}

static Py_ssize_t number_of_paths(const PyPool *self, const Arguments *a) {
    const Py_ssize_t parts = self->system == NULL ? 1 : (Py_ssize_t)self->system->count;
    return parts * (a->private_libraries ? a->count : 1);
}

static PyObject *pool_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) {
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyPool *self = (PyPool *)allocate(type, 0);
    Arguments a;

    if (self == NULL) {
        return NULL;
    }
    self->arguments = copy_of_groups(kwargs);
    if (self->arguments != NULL && parse(self, args, self->arguments, &a) && check_numbers(&a) &&
        check_start_outputs(self, &a) && check_accesses(&a) && take_system(a.system, &self->system) && check_system(self, &a) && take_paths(self, a.paths, number_of_paths(self, &a)) &&
        take_categories(self, a.categories) && take_arrays(self, &a) && settle(self, &a) &&
        open_pool(self)) {
        return (PyObject *)self;
    }
    Py_DECREF(self);
    return NULL;
}

static PyMethodDef methods[] = {
#define FAST(name, function) {name, (PyCFunction)(void (*)(void))function, METH_FASTCALL, NULL}
    {"step_own", py_step_own, METH_NOARGS, NULL},
    FAST("step", py_step),
    FAST("reset", py_reset),
    FAST("step_or_reset", py_step_or_reset),
    {"prepare_play", (PyCFunction)(void (*)(void))py_prepare_play, METH_VARARGS | METH_KEYWORDS,
     NULL},
    FAST("play", py_play),
    FAST("play_before", py_play_before),
    FAST("play_after", py_play_after),
    FAST("rollout", py_rollout),
    {"exchange_play", py_exchange_play, METH_O, NULL},
    {"prepare_single", (PyCFunction)(void (*)(void))py_prepare_single,
     METH_VARARGS | METH_KEYWORDS, NULL},
    FAST("step_single", py_step_single),
    FAST("before_single", py_before_single),
    {"after_single", py_after_single, METH_O, NULL},
    {"begin_single", py_begin_single, METH_O, NULL},
    {"actions_of_single", py_actions_of_single, METH_NOARGS, NULL},
    FAST("start", py_start),
    {"reset_by", py_reset_by, METH_O, NULL},
    {"save", py_save, METH_NOARGS, NULL},
    FAST("restore", py_restore),
    FAST("read", py_read),
    FAST("write", py_write),
    {"failure", py_failure, METH_O, NULL},
    FAST("knows_start", py_knows_start),
    {"pack", py_pack, METH_O, NULL},
    FAST("adopt", py_adopt),
    FAST("bundle", py_bundle),
    FAST("unbundle", py_unbundle),
    {"keep_records", py_keep_records, METH_NOARGS, NULL},
    {"record_of", py_record_of, METH_O, NULL},
    {"replace_record", (PyCFunction)(void (*)(void))py_replace_record, METH_FASTCALL, NULL},
    {"count_steps", py_count_steps, METH_NOARGS, NULL},
    {"recycle", py_recycle, METH_NOARGS, NULL},
    FAST("record", py_record),
    FAST("begin_by", py_begin_by),
    {"close", py_close, METH_NOARGS, NULL},
    {"costs", py_costs, METH_NOARGS, NULL},
    {"uses_states", py_uses_states, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)pool_new},
    {Py_tp_dealloc, (void *)pool_dealloc},
    {Py_tp_methods, methods},
    {0, NULL},
};

PyType_Spec pool_spec = {"fmugym._native.Pool", sizeof(PyPool), 0, Py_TPFLAGS_DEFAULT, slots};
