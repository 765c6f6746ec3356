/* The arguments that a pool is made of. Each is a dict of named values. */

#include <stdlib.h>

#include "python.h"

typedef struct {
    PyObject *paths, *categories, *solving, *system, *stop_time, *tolerance;
    PyAccess *inputs, *outputs;
    Py_ssize_t size_of_places;
    Py_ssize_t size_of_references, size_of_values; /* of structural parameters */
    Py_ssize_t num_observed, count, threads, start_outputs_size;
    int version, manner, private_libraries, logging, can_save;
    int restores, rebuilds, reloads, one_initialization, records;
    long long substeps, warm_up_steps, retries;
    const char *sampling;
    Py_ssize_t samplings;
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
                            "private", "logging", "states", "categories", "solving", "system",
                            "structural_references", "structural_values", NULL};
    Settings *s = &self->pool.settings;
    return parse_group(group, "$iiyyyO!pppO!OOy#y#:library", names, &a->version, &a->manner, &s->model,
                       &s->token, &s->resources, &PyTuple_Type, &a->paths, &a->private_libraries, &a->logging,
                       &a->can_save, &PyTuple_Type, &a->categories, &a->solving, &a->system,
                       &s->experiment.structural_references, &a->size_of_references,
                       &s->experiment.structural_values, &a->size_of_values);
}

static bool parse_experiment(PyPool *self, PyObject *group, Arguments *a) {
    static char *names[] = {"start_time", "stop_time",     "tolerance", "time_step",
                            "substeps",   "warm_up_steps", "retries",   "restores",
                            "rebuilds",   "reloads",       "one_initialization",
                            "records",    "start_outputs", NULL};
    Settings *s = &self->pool.settings;
    return parse_group(group, "$dOOdLLLpppppz#:experiment", names, &s->experiment.start_time,
                       &a->stop_time, &a->tolerance, &s->time_step, &a->substeps, &a->warm_up_steps,
                       &a->retries, &a->restores, &a->rebuilds, &a->reloads,
                       &a->one_initialization, &a->records, &s->start_outputs, &a->start_outputs_size);
}

static bool parse_variables(PyObject *group, Arguments *a) {
    static char *names[] = {"inputs", "outputs", "num_observed", "sampling", NULL};
    return parse_group(group, "$O!O!ny#:variables", names, access_type, &a->inputs, access_type,
                       &a->outputs, &a->num_observed, &a->sampling, &a->samplings);
}

static bool parse_arrays(PyPool *self, PyObject *group) {
    static char *names[] = {"inputs",       "outputs", "statuses",
                            "observations", "health",  NULL};
    PyObject **arrays = self->arrays;
    return parse_group(group, "$OOOOO:arrays", names, &arrays[INPUTS], &arrays[OUTPUTS],
                       &arrays[STATUS], &arrays[OBSERVATIONS], &arrays[HEALTH]);
}

static bool parse(PyPool *self, PyObject *args, PyObject *kwargs, Arguments *a) {
    static char *names[] = {"library", "experiment", "variables", "arrays",
                            "count",   "threads",    "callback",  NULL};
    PyObject *library, *experiment, *variables, *arrays;

    return PyArg_ParseTupleAndKeywords(args, kwargs, "$O!O!O!O!nnO:Pool", names, &PyDict_Type,
                                       &library, &PyDict_Type, &experiment, &PyDict_Type,
                                       &variables, &PyDict_Type, &arrays, &a->count, &a->threads,
                                       &self->callback) &&
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
                       HEALTH_COUNTS);
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
    s->records = a->records;
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
    return take_solving(a->solving, &s->solving) &&
           take_optional(a->stop_time, &s->experiment.has_stop_time, &s->experiment.stop_time) &&
           take_optional(a->tolerance, &s->experiment.has_tolerance, &s->experiment.tolerance);
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

bool take_pool_arguments(PyPool *self, PyObject *args, PyObject *kwargs) {
    Arguments a;

    self->arguments = copy_of_groups(kwargs);
    return self->arguments != NULL && parse(self, args, self->arguments, &a) && check_numbers(&a) &&
           check_start_outputs(self, &a) && check_accesses(&a) &&
           take_system(a.system, &self->system) && check_system(self, &a) &&
           take_paths(self, a.paths, number_of_paths(self, &a)) &&
           take_categories(self, a.categories) && take_arrays(self, &a) && settle(self, &a);
}
