/* The arrays of a step or a reset: taken over once, provided for each call, and returned in tuples. */

#include "python/results.h"

#include <string.h>

/* Taking over */

static bool take_makers(Results *r, PyObject *shapes) {
    const Py_ssize_t count = PyTuple_Size(shapes), seen = count - OTHER_ARRAYS;

    if (seen < 0 || count > RESULT_ARRAYS) {
        PyErr_SetString(PyExc_ValueError, "results have too few or too many arrays");
        return false;
    }
    r->number_of_seen = (size_t)seen;
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *arguments = PyTuple_GetItem(shapes, i);
        if (!maker_take(&r->makers[i], arguments) ||
            (i < seen && !maker_take(&r->last[i], arguments))) {
            return false;
        }
    }
    return true;
}

bool results_take(Results *r, PyObject *parts) {
    int are_of_one;
    PyObject *shapes;

    if (!PyTuple_Check(parts)) {
        PyErr_SetString(PyExc_TypeError, "expected a tuple of results");
        return false;
    }
    if (!PyArg_ParseTuple(parts, "pO!;results", &are_of_one, &PyTuple_Type, &shapes)) {
        return false;
    }
    r->are_of_one = are_of_one != 0;
    return numpy_import() && take_makers(r, shapes);
}

void results_drop(Results *r) {
    for (size_t i = 0; i < RESULT_ARRAYS; i++) {
        maker_drop(&r->makers[i]);
    }
    for (size_t i = 0; i < MOST_SEEN; i++) {
        maker_drop(&r->last[i]);
    }
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
    memset(a->arrays, 0, results_place(r, OTHER_ARRAYS) * sizeof *a->arrays);
    memset(a->last, 0, r->number_of_seen * sizeof *a->last);
}

bool results_provide_step(Results *r, ResultArrays *a) {
    clear(r, a);
    return provide_some(r, 0, results_place(r, STEP_ARRAYS), a);
}

static bool provide_others(Results *r, ResultArrays *a) {
    return provide_some(r, results_place(r, MASK_ARRAY), results_place(r, OTHER_ARRAYS), a);
}

static bool provide_last(Results *r, ResultArrays *a) {
    for (size_t i = 0; i < r->number_of_seen; i++) {
        a->last[i] = maker_provide(&r->last[i], &a->last_memory[i]);
        if (a->last[i] == NULL) {
            return false;
        }
        maker_blank(&r->last[i], a->last_memory[i]);
    }
    return true;
}

bool results_provide_starts(Results *r, bool at_ends, ResultArrays *a) {
    return (!at_ends || provide_last(r, a)) && provide_others(r, a);
}

bool results_provide_reset(Results *r, ResultArrays *a) {
    clear(r, a);
    return provide_some(r, 0, r->number_of_seen, a) && provide_others(r, a);
}

void results_release(const Results *r, ResultArrays *a) {
    for (size_t i = 0; i < results_place(r, OTHER_ARRAYS); i++) {
        Py_XDECREF(a->arrays[i]);
    }
    for (size_t i = 0; i < r->number_of_seen; i++) {
        Py_XDECREF(a->last[i]);
    }
}

bool results_copy_mask(const Results *r, PyObject *mask, const ResultArrays *a) {
    const size_t place = results_place(r, MASK_ARRAY);
    const Maker *own = &r->makers[place];
    const char *memory = maker_memory_of(own, mask);

    if (memory == NULL) {
        return false;
    }
    memcpy(a->memory[place], memory, own->size);
    return memchr(a->memory[place], 1, own->size) != NULL;
}

/* Returning */

static PyObject *seen_of(const Results *r, PyObject *const *arrays) {
    PyObject *seen = PyTuple_New((Py_ssize_t)r->number_of_seen);

    for (size_t i = 0; i < r->number_of_seen && seen != NULL; i++) {
        PyTuple_SetItem(seen, (Py_ssize_t)i, Py_NewRef(arrays[i]));
    }
    return seen;
}

static PyObject *other_of(const Results *r, const ResultArrays *a, size_t other) {
    return Py_NewRef(a->arrays[results_place(r, other)]);
}

/* Rewards, terminated or truncated: an array, or for a single environment a float or a bool. */
static PyObject *judged_of(const Results *r, const ResultArrays *a, size_t other) {
    if (!r->are_of_one) {
        return other_of(r, a, other);
    }
    const char *memory = a->memory[results_place(r, other)];
    return other == REWARDS_ARRAY ? PyFloat_FromDouble(*(const double *)(const void *)memory)
                                  : PyBool_FromLong(*memory);
}

static PyObject *tuple_of(PyObject *const *parts, Py_ssize_t count) {
    PyObject *tuple = PyTuple_New(count);
    bool good = tuple != NULL;

    for (Py_ssize_t i = 0; i < count; i++) {
        good = good && parts[i] != NULL;
        if (tuple == NULL) {
            Py_XDECREF(parts[i]);
        } else {
            PyTuple_SetItem(tuple, i, parts[i]);
        }
    }
    if (!good) {
        Py_CLEAR(tuple);
    }
    return tuple;
}

static PyObject *starts_of(const Results *r, const ResultArrays *a, bool at_ends) {
    PyObject *const parts[] = {
        other_of(r, a, MASK_ARRAY),
        other_of(r, a, DRAWN_ARRAY),
        at_ends ? seen_of(r, a->last) : Py_NewRef(Py_None),
    };
    return tuple_of(parts, sizeof parts / sizeof *parts);
}

PyObject *results_of_step(const Results *r, const ResultArrays *a, size_t troubled, bool any_ended,
                          bool any_started, bool at_ends) {
    PyObject *const parts[] = {
        PyLong_FromSize_t(troubled),
        PyBool_FromLong(any_ended),
        judged_of(r, a, REWARDS_ARRAY),
        judged_of(r, a, TERMINATED_ARRAY),
        judged_of(r, a, TRUNCATED_ARRAY),
        seen_of(r, a->arrays),
        any_started ? starts_of(r, a, at_ends) : Py_NewRef(Py_None),
    };
    return tuple_of(parts, sizeof parts / sizeof *parts);
}

PyObject *results_of_reset(const Results *r, const ResultArrays *a, size_t troubled,
                           bool any_ended) {
    PyObject *const parts[] = {
        PyLong_FromSize_t(troubled),         PyBool_FromLong(any_ended),
        seen_of(r, a->arrays),               other_of(r, a, MASK_ARRAY),
        other_of(r, a, DRAWN_ARRAY),
    };
    return tuple_of(parts, sizeof parts / sizeof *parts);
}
