/* The form of observations or infos: an array, or a dict of forms by name. */

#include "forms.h"

#include <stdlib.h>

enum { MOST_LEVELS = 100 }; /* of dicts in dicts */

static bool take_array(Form *form, PyObject *number, size_t number_of_arrays) {
    form->is_array = true;
    form->array = PyLong_AsSize_t(number);
    if (!PyErr_Occurred() && form->array >= number_of_arrays) {
        PyErr_SetString(PyExc_ValueError, "the form of results has too few arrays");
    }
    return !PyErr_Occurred();
}

static bool take_form(Form *form, PyObject *parts, size_t number_of_arrays, int levels);

static bool take_item(Form *item, PyObject *pair, size_t number_of_arrays, int levels) {
    PyObject *name, *parts;

    if (!PyTuple_Check(pair)) {
        PyErr_SetString(PyExc_TypeError, "expected a tuple of a name and a form");
        return false;
    }
    if (!PyArg_ParseTuple(pair, "OO;a name and a form", &name, &parts)) {
        return false;
    }
    item->name = Py_NewRef(name);
    item->name_of_mask = PyUnicode_FromFormat("_%S", name);
    return item->name_of_mask != NULL &&
           take_form(item, parts, number_of_arrays, levels - 1);
}

static bool take_form(Form *form, PyObject *parts, size_t number_of_arrays, int levels) {
    if (PyLong_Check(parts)) {
        return take_array(form, parts, number_of_arrays);
    }
    if (!PyTuple_Check(parts) || levels == 0) {
        PyErr_SetString(PyExc_TypeError, "the form of results is no number and no tuple of pairs");
        return false;
    }
    const size_t count = (size_t)PyTuple_Size(parts);
    form->items = calloc(count + 1, sizeof *form->items);
    if (form->items == NULL) {
        PyErr_NoMemory();
        return false;
    }
    for (form->count = 0; form->count < count; form->count++) {
        PyObject *pair = PyTuple_GetItem(parts, (Py_ssize_t)form->count);
        if (!take_item(&form->items[form->count], pair, number_of_arrays, levels)) {
            form->count++; /* to be dropped, too */
            return false;
        }
    }
    return true;
}

bool form_take(Form *form, PyObject *parts, size_t number_of_arrays) {
    return take_form(form, parts, number_of_arrays, MOST_LEVELS);
}

void form_drop(Form *form) {
    for (size_t i = 0; i < form->count; i++) {
        form_drop(&form->items[i]);
    }
    free(form->items);
    Py_CLEAR(form->name);
    Py_CLEAR(form->name_of_mask);
    *form = (Form){.is_array = false};
}

bool set_item(PyObject *dict, PyObject *name, PyObject *object) {
    const bool is_set = object != NULL && PyDict_SetItem(dict, name, object) == 0;

    Py_XDECREF(object);
    return is_set;
}

PyObject *form_of(const Form *form, PyObject *const *arrays) {
    if (form->is_array) {
        return Py_NewRef(arrays[form->array]);
    }
    PyObject *dict = PyDict_New();
    for (size_t i = 0; i < form->count && dict != NULL; i++) {
        if (!set_item(dict, form->items[i].name, form_of(&form->items[i], arrays))) {
            Py_CLEAR(dict);
        }
    }
    return dict;
}
