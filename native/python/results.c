/* The results of a step or a reset: arrays, tuples and dicts. */

#include "results.h"

#include <stdlib.h>
#include <string.h>

#include "infos.h"

struct Results {
    PyObject *parts;
    PyTypeObject *class;
    allocfunc allocate;
    PyObject *late, *unfilled, *tell; /* what infos tell of the episodes that start: see LateDict */
    size_t number_of_seen;
    Maker makers[RESULT_ARRAYS], last[MOST_SEEN];
    Form observations, infos;
};

enum { DRAWN, MASK_OF_DRAWN, FINAL_OBS, MASK_OF_FINAL_OBS, FINAL_INFO, MASK_OF_FINAL_INFO, NAMES };

static PyObject *names[NAMES]; /* of this process: other interpreters cannot load this extension */

/* Making a name takes as long as setting an item. */
static bool know_names(void) {
    static const char *const texts[NAMES] = {"drawn",      "_drawn",     "final_obs",
                                             "_final_obs", "final_info", "_final_info"};

    for (int i = 0; i < NAMES; i++) {
        if (names[i] == NULL) {
            names[i] = PyUnicode_InternFromString(texts[i]);
        }
        if (names[i] == NULL) {
            return false;
        }
    }
    return true;
}

/* Taking over */

static bool take_makers(Results *r, PyObject *shapes) {
    const Py_ssize_t count = PyTuple_Size(shapes), judged = RESULT_ARRAYS - MOST_SEEN;

    if (count < judged || count > RESULT_ARRAYS) {
        PyErr_SetString(PyExc_ValueError, "results have too few or too many arrays");
        return false;
    }
    r->number_of_seen = (size_t)(count - judged);
    for (Py_ssize_t i = 0; i < count; i++) {
        const Py_ssize_t later = i - (count - judged);
        PyObject *arguments = PyTuple_GetItem(shapes, i);
        if (!maker_take(&r->makers[later < 0 ? i : MOST_SEEN + later], arguments) ||
            (later < 0 && !maker_take(&r->last[i], arguments))) {
            return false;
        }
    }
    return true;
}

static bool take_forms(Results *r, PyObject *observations, PyObject *infos) {
    if (!form_take(&r->observations, observations, r->number_of_seen) ||
        !form_take(&r->infos, infos, r->number_of_seen)) {
        return false;
    }
    if (r->infos.is_array) {
        PyErr_SetString(PyExc_TypeError, "infos are no array");
    }
    return !r->infos.is_array;
}

static bool take_class(Results *r) {
    r->allocate = (allocfunc)PyType_GetSlot(r->class, Py_tp_alloc);
    if (r->allocate == NULL || !PyType_IsSubtype(r->class, &PyTuple_Type)) {
        PyErr_SetString(PyExc_TypeError, "results must be tuples");
        return false;
    }
    return true;
}

static bool take_parts(Results *r, PyObject *parts) {
    PyObject *observations, *infos, *shapes;

    return PyArg_ParseTuple(parts, "O!OOO!(OOO);results", &PyType_Type, &r->class, &observations,
                            &infos, &PyTuple_Type, &shapes, &r->late, &r->unfilled, &r->tell) &&
           know_names() && take_class(r) && numpy_import() && take_makers(r, shapes) &&
           take_forms(r, observations, infos);
}

Results *results_take(PyObject *parts) {
    Results *r = calloc(1, sizeof *r);

    if (r == NULL) {
        PyErr_NoMemory();
        return NULL;
    }
    r->parts = Py_NewRef(parts); /* keeps the rest alive */
    if (!PyTuple_Check(parts)) {
        PyErr_SetString(PyExc_TypeError, "expected a tuple of results");
    } else if (take_parts(r, parts)) {
        return r;
    }
    results_free(r);
    return NULL;
}

void results_free(Results *r) {
    if (r == NULL) {
        return;
    }
    form_drop(&r->observations);
    form_drop(&r->infos);
    for (size_t i = 0; i < RESULT_ARRAYS; i++) {
        maker_drop(&r->makers[i]);
    }
    for (size_t i = 0; i < r->number_of_seen; i++) {
        maker_drop(&r->last[i]);
    }
    Py_XDECREF(r->parts);
    free(r);
}

bool results_are_of_one(const Results *r) {
    return r->late == Py_None;
}

size_t results_number_of_seen(const Results *r) {
    return r->number_of_seen;
}

size_t results_size(const Results *r, size_t array) {
    return r->makers[array].size;
}

/* Providing */

static bool provide_some(Results *r, size_t begin, size_t end, ResultArrays *a) {
    for (size_t i = begin; i < end; i++) {
        a->arrays[i] = maker_provide(&r->makers[i], &a->memory[i]);
        if (a->arrays[i] == NULL) {
            return false;
        }
    }
    return true;
}

/* Whatever fails, all arrays can be dropped. */
static void clear(const Results *r, ResultArrays *a) {
    memset(a->arrays, 0, r->number_of_seen * sizeof *a->arrays);
    memset(a->arrays + MOST_SEEN, 0, (RESULT_ARRAYS - MOST_SEEN) * sizeof *a->arrays);
    memset(a->last, 0, r->number_of_seen * sizeof *a->last);
}

bool results_provide_step(Results *r, ResultArrays *a) {
    clear(r, a);
    return provide_some(r, 0, r->number_of_seen, a) &&
           provide_some(r, REWARDS_ARRAY, TRUNCATED_ARRAY + 1, a);
}

static bool provide_last(Results *r, ResultArrays *a) {
    for (size_t i = 0; i < r->number_of_seen; i++) {
        a->last[i] = maker_provide(&r->last[i], &a->last_memory[i]);
        if (a->last[i] == NULL) {
            return false;
        }
    }
    return true;
}

bool results_provide_starts(Results *r, bool at_ends, ResultArrays *a) {
    return (!at_ends || provide_last(r, a)) && provide_some(r, MASK_ARRAY, DRAWN_ARRAY + 1, a);
}

bool results_provide_reset(Results *r, ResultArrays *a) {
    clear(r, a);
    return provide_some(r, 0, r->number_of_seen, a) &&
           provide_some(r, MASK_ARRAY, DRAWN_ARRAY + 1, a);
}

void results_drop(const Results *r, ResultArrays *a) {
    for (size_t i = 0; i < r->number_of_seen; i++) {
        Py_XDECREF(a->arrays[i]);
        Py_XDECREF(a->last[i]);
    }
    for (size_t i = MOST_SEEN; i < RESULT_ARRAYS; i++) {
        Py_XDECREF(a->arrays[i]);
    }
}

bool results_copy_mask(const Results *r, PyObject *mask, const ResultArrays *a) {
    const Maker *own = &r->makers[MASK_ARRAY];
    const char *memory = maker_memory_of(own, mask);

    if (memory == NULL) {
        return false;
    }
    memcpy(a->memory[MASK_ARRAY], memory, own->size);
    return memchr(a->memory[MASK_ARRAY], 1, own->size) != NULL;
}

/* Returning */

/* A dict that calls the function when it is read, which is rare. */
static PyObject *told_late(const Results *r, const ResultArrays *a) {
    PyObject *late = PyObject_CallNoArgs(r->late);
    PyObject *call = PyTuple_Pack(3, r->tell, a->arrays[DRAWN_ARRAY], a->arrays[MASK_ARRAY]);

    if (late != NULL && !set_item(late, r->unfilled, Py_XNewRef(call))) {
        Py_CLEAR(late);
    }
    Py_XDECREF(call);
    return late;
}

static bool add_starts(const Results *r, PyObject *infos, const ResultArrays *a) {
    return set_item(infos, names[DRAWN], told_late(r, a)) &&
           set_item(infos, names[MASK_OF_DRAWN], Py_NewRef(a->arrays[MASK_ARRAY]));
}

static Origin origin_of(const Results *r, const ResultArrays *a) {
    return (Origin){r->makers, &r->makers[MASK_ARRAY], a->arrays, a->memory, NULL};
}

static PyObject *infos_within(const Origin *origin, const Form *form) {
    PyObject *infos = PyDict_New();

    if (infos != NULL && !infos_add(origin, form, infos)) {
        Py_CLEAR(infos);
    }
    return infos;
}

static bool add_ends(Results *r, PyObject *infos, const ResultArrays *a) {
    const char *mask = a->memory[MASK_ARRAY];
    Origin origin = origin_of(r, a);

    origin.memory = a->last_memory;
    origin.mask = mask;
    return set_item(infos, names[FINAL_OBS], infos_observations(&origin, &r->observations)) &&
           set_item(infos, names[MASK_OF_FINAL_OBS], infos_mask(&origin)) &&
           set_item(infos, names[FINAL_INFO], infos_within(&origin, &r->infos)) &&
           set_item(infos, names[MASK_OF_FINAL_INFO], infos_mask(&origin));
}

static PyObject *infos_of_step(Results *r, const ResultArrays *a, bool any_started,
                               bool at_ends) {
    const Origin origin = origin_of(r, a);
    PyObject *infos = infos_within(&origin, &r->infos);

    if (infos != NULL && any_started &&
        (!add_starts(r, infos, a) || (at_ends && !add_ends(r, infos, a)))) {
        Py_CLEAR(infos);
    }
    return infos;
}

/* The rewards, or where episodes have ended; of a single environment a number. */
static PyObject *judged_of(const Results *r, const ResultArrays *a, size_t array) {
    if (!results_are_of_one(r)) {
        return Py_NewRef(a->arrays[array]);
    }
    const char *memory = a->memory[array];
    return array == REWARDS_ARRAY ? PyFloat_FromDouble(*(const double *)(const void *)memory)
                                  : PyBool_FromLong(*memory);
}

/* Makes the tuple without the constructor of its class, which takes several times as long. */
PyObject *results_of_step(Results *r, const ResultArrays *a, bool any_started, bool at_ends) {
    PyObject *observations = form_of(&r->observations, a->arrays);
    PyObject *infos = observations == NULL ? NULL : infos_of_step(r, a, any_started, at_ends);
    PyObject *result = infos == NULL ? NULL : r->allocate(r->class, 5);

    if (result == NULL) {
        Py_XDECREF(observations);
        Py_XDECREF(infos);
        return NULL;
    }
    PyTuple_SetItem(result, 0, observations);
    for (Py_ssize_t i = 0; i < 3; i++) {
        PyTuple_SetItem(result, 1 + i, judged_of(r, a, REWARDS_ARRAY + (size_t)i));
    }
    PyTuple_SetItem(result, 4, infos);
    return result;
}

static PyObject *infos_of_reset(Results *r, const ResultArrays *a) {
    Origin origin = origin_of(r, a);

    origin.mask = a->memory[MASK_ARRAY];
    PyObject *infos = infos_within(&origin, &r->infos);
    if (infos != NULL && !add_starts(r, infos, a)) {
        Py_CLEAR(infos);
    }
    return infos;
}

PyObject *results_of_reset(Results *r, const ResultArrays *a) {
    PyObject *infos = infos_of_reset(r, a);
    PyObject *observations = infos == NULL ? NULL : form_of(&r->observations, a->arrays);
    PyObject *result = observations == NULL ? NULL : PyTuple_Pack(2, observations, infos);

    Py_XDECREF(observations);
    Py_XDECREF(infos);
    return result;
}
