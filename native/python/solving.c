/* What pools and the parts of systems are made of alike. */

#include <stdlib.h>

#include "python.h"

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

static bool take_method(const char *name, Solving *solving) {
    solving->method = method_of(name);
    if (solving->method == NULL) {
        PyErr_Format(PyExc_ValueError, "there is no solver %s", name);
    }
    return solving->method != NULL;
}

/* The references stay in the pool's arguments. */
bool take_solving(PyObject *tuple, Solving *solving) {
    const char *method, *states, *rates, *clocks, *clocked;
    Py_ssize_t count, indicators, states_size, rates_size, clocks_size, clocked_size;
    int completes;

    if (tuple == Py_None) {
        return true;
    }
    if (!PyArg_ParseTuple(tuple, "yddnnpz#z#y#y#", &method, &solving->tolerance,
                          &solving->max_step, &count, &indicators, &completes, &states,
                          &states_size, &rates, &rates_size, &clocks, &clocks_size, &clocked,
                          &clocked_size)) {
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
    return take_method(method, solving);
}
