/* The arrays of a step or a reset: taken over once, provided for each call, and returned in tuples. */

#include "python/results.h"

#include <string.h>

/* Taking over */

bool results_take(Results *r, bool are_of_one, PyObject *patterns) {
    const Py_ssize_t count = PyTuple_Size(patterns), seen = count - LAST_ARRAYS;

    if (seen < 0 || count > RESULT_ARRAYS) {
        PyErr_SetString(PyExc_ValueError, "results have too few or too many arrays");
        return false;
    }
    r->are_of_one = are_of_one;
    r->number_of_seen = (size_t)seen;
    for (Py_ssize_t i = 0; i < count + seen; i++) {
        PyObject *pattern = PyTuple_GetItem(patterns, i % count);
        if (!maker_take(&r->makers[i], (PyArrayObject *)pattern)) {
            return false;
        }
    }
    return true;
}

void results_drop(Results *r) {
    for (size_t i = 0; i < RESULT_ARRAYS; i++) {
        maker_drop(&r->makers[i]);
    }
}

/* Providing */

static size_t end_of(const Results *r) {
    return results_place(r, LAST_ARRAYS) + r->number_of_seen;
}

static bool provide(Results *r, size_t begin, size_t end, ResultArrays *a) {
    for (size_t i = begin; i < end; i++) {
        a->arrays[i] = maker_provide(&r->makers[i], &a->memory[i]);
        if (a->arrays[i] == NULL) {
            return false;
        }
    }
    return true;
}

/* Whatever fails, all arrays can be released. */
static void clear(const Results *r, ResultArrays *a) {
    memset(a->arrays, 0, end_of(r) * sizeof *a->arrays);
}

bool results_provide_step(Results *r, ResultArrays *a) {
    clear(r, a);
    return provide(r, 0, results_place(r, STEP_ARRAYS), a);
}

bool results_provide_starts(Results *r, bool at_ends, ResultArrays *a) {
    const size_t last = results_place(r, LAST_ARRAYS), end = at_ends ? end_of(r) : last;

    if (!provide(r, results_place(r, MASK_ARRAY), end, a)) {
        return false;
    }
    for (size_t i = last; i < end; i++) {
        maker_blank(&r->makers[i], a->memory[i]);
    }
    return true;
}

bool results_provide_reset(Results *r, ResultArrays *a) {
    clear(r, a);
    return provide(r, 0, r->number_of_seen, a) && results_provide_starts(r, false, a);
}

void results_release(const Results *r, ResultArrays *a) {
    for (size_t i = 0; i < end_of(r); i++) {
        Py_XDECREF(a->arrays[i]);
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

/* Takes the references; Py_BuildValue takes twice as long. */
static PyObject *tuple_of(PyObject *const *parts, Py_ssize_t count) {
    PyObject *tuple = PyTuple_New(count);

    for (Py_ssize_t i = 0; i < count; i++) {
        if (tuple != NULL && parts[i] != NULL) {
            PyTuple_SetItem(tuple, i, parts[i]);
        } else {
            Py_XDECREF(parts[i]);
            Py_CLEAR(tuple);
        }
    }
    return tuple;
}

static PyObject *starts_of(const Results *r, const ResultArrays *a, bool at_ends) {
    PyObject *const parts[] = {
        other_of(r, a, MASK_ARRAY),
        other_of(r, a, DRAWN_ARRAY),
        at_ends ? seen_of(r, a->arrays + results_place(r, LAST_ARRAYS)) : Py_NewRef(Py_None),
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
        PyLong_FromSize_t(troubled),  PyBool_FromLong(any_ended),   seen_of(r, a->arrays),
        other_of(r, a, MASK_ARRAY), other_of(r, a, DRAWN_ARRAY),
    };
    return tuple_of(parts, sizeof parts / sizeof *parts);
}
