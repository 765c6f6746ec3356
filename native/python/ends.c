#include "ends.h"

#include <stdlib.h>
#include <string.h>

#include "program.h"

enum { MOST_KEPT = 1 << 20, /* bytes of arrays that wait for their next use */
       SIZE_OF_ARRAY = 128  /* an array of numpy without its memory, about */ };

/* The observations of single environments that one array of all of them holds. */
typedef struct {
    Maker maker;
    PyObject **spare; /* arrays that nobody else holds */
    size_t number_of_spare, most;
    size_t size;    /* in bytes */
    bool is_scalar; /* then it is no array, and no maker is there */
} RowMaker;

struct Observed {
    size_t count;
    const Form *form;
    size_t number_of_rows;
    Maker objects;
    RowMaker *rows;
};

/* Taking over */

static bool take_row(RowMaker *row, const Maker *all, size_t count) {
    row->size = count > 0 ? all->size / count : 0;
    row->is_scalar = all->dimensions == 1;
    if (row->is_scalar) {
        return true;
    }
    const size_t most = MOST_KEPT / (row->size + SIZE_OF_ARRAY);
    row->most = most < count ? most : count;
    row->spare = calloc(row->most + 1, sizeof *row->spare);
    if (row->spare == NULL) {
        PyErr_NoMemory();
        return false;
    }
    return maker_take_part(&row->maker, all, 1);
}

static bool take_objects(Observed *o) {
    PyObject *arguments = Py_BuildValue("((n)s)", (Py_ssize_t)o->count, "O");
    const bool taken = arguments != NULL && maker_take(&o->objects, arguments);

    Py_XDECREF(arguments);
    return taken;
}

static bool take_all(Observed *o, const Maker *arrays) {
    bool good = take_objects(o);

    o->rows = calloc(o->number_of_rows + 1, sizeof *o->rows);
    if (o->rows == NULL && good) {
        PyErr_NoMemory();
        good = false;
    }
    for (size_t i = 0; i < o->number_of_rows && good; i++) {
        good = take_row(&o->rows[i], &arrays[i], o->count);
    }
    return good;
}

Observed *observed_take(const Maker *arrays, size_t number_of_arrays, size_t count,
                        const Form *form) {
    Observed *o = calloc(1, sizeof *o);

    if (o == NULL) {
        PyErr_NoMemory();
        return NULL;
    }
    *o = (Observed){.count = count, .form = form, .number_of_rows = number_of_arrays};
    if (!take_all(o, arrays)) {
        observed_free(o);
        return NULL;
    }
    return o;
}

static void drop_row(RowMaker *row) {
    while (row->number_of_spare > 0) {
        Py_DECREF(row->spare[--row->number_of_spare]);
    }
    free(row->spare);
    maker_drop(&row->maker);
}

void observed_free(Observed *o) {
    if (o == NULL) {
        return;
    }
    maker_drop(&o->objects);
    for (size_t i = 0; i < o->number_of_rows && o->rows != NULL; i++) {
        drop_row(&o->rows[i]);
    }
    free(o->rows);
    free(o);
}

/* Taking back what an array of objects has held. The caller's references end here. */

static void keep(RowMaker *row, PyObject *object) {
    char *memory;

    if (Py_REFCNT(object) == 1 && row->number_of_spare < row->most &&
        maker_knows(&row->maker, object, &memory)) {
        row->spare[row->number_of_spare++] = object;
    } else {
        Py_DECREF(object);
    }
}

static void take_back(Observed *o, const Form *form, PyObject *object);

static void take_back_items(Observed *o, const Form *form, PyObject *dict) {
    PyObject *items[MOST_SEEN];

    for (size_t i = 0; i < form->count; i++) {
        items[i] = PyDict_GetItemWithError(dict, form->items[i].name);
        Py_XINCREF(items[i]);
        PyErr_Clear(); /* a key of the caller's cannot be compared */
    }
    Py_DECREF(dict);
    for (size_t i = 0; i < form->count; i++) {
        if (items[i] != NULL) {
            take_back(o, &form->items[i], items[i]);
        }
    }
}

static void take_back(Observed *o, const Form *form, PyObject *object) {
    if (form->is_array) {
        keep(&o->rows[form->array], object);
    } else if (PyDict_CheckExact(object) && Py_REFCNT(object) == 1 && form->count <= MOST_SEEN) {
        take_back_items(o, form, object);
    } else {
        Py_DECREF(object);
    }
}

static void clear(Observed *o, PyObject **objects) {
    for (size_t i = 0; i < o->count; i++) {
        PyObject *object = objects[i];
        if (object != Py_None) {
            objects[i] = Py_NewRef(Py_None); /* first, because the end of an object may call back */
            if (object != NULL) {
                take_back(o, o->form, object);
            }
        }
    }
}

/* Filling */

static PyObject *array_of(RowMaker *row, char **memory) {
    while (row->number_of_spare > 0) {
        PyObject *spare = row->spare[--row->number_of_spare];
        if (maker_knows(&row->maker, spare, memory)) {
            return spare;
        }
        Py_DECREF(spare);
    }
    return maker_make(&row->maker, memory);
}

static PyObject *row_of(RowMaker *row, size_t index, PyObject *all, const char *memory_of_all) {
    char *memory;

    if (row->is_scalar) {
        return PySequence_GetItem(all, (Py_ssize_t)index);
    }
    PyObject *array = array_of(row, &memory);
    if (array != NULL) {
        memcpy(memory, memory_of_all + index * row->size, row->size);
    }
    return array;
}

static PyObject *seen_by(Observed *o, const Form *form, size_t index, PyObject *const *arrays,
                         char *const *memory) {
    const size_t array = form->array;

    if (form->is_array) {
        return row_of(&o->rows[array], index, arrays[array], memory[array]);
    }
    PyObject *dict = PyDict_New();
    for (size_t i = 0; i < form->count && dict != NULL; i++) {
        const Form *item = &form->items[i];
        if (!set_item(dict, item->name, seen_by(o, item, index, arrays, memory))) {
            Py_CLEAR(dict);
        }
    }
    return dict;
}

static bool fill(Observed *o, PyObject **objects, const char *mask, PyObject *const *arrays,
                 char *const *memory) {
    const char *const end = mask + o->count;

    for (const char *at = mask; (at = memchr(at, 1, (size_t)(end - at))) != NULL; at++) {
        const size_t index = (size_t)(at - mask);
        PyObject *seen = seen_by(o, o->form, index, arrays, memory);
        if (seen == NULL) {
            return false;
        }
        Py_DECREF(objects[index]); /* None */
        objects[index] = seen;
    }
    return true;
}

PyObject *observed_of(Observed *o, const char *mask, PyObject *const *arrays,
                      char *const *memory) {
    char *objects;
    PyObject *array = maker_provide(&o->objects, &objects);

    if (array == NULL) {
        return NULL;
    }
    clear(o, (PyObject **)(void *)objects);
    if (!fill(o, (PyObject **)(void *)objects, mask, arrays, memory)) {
        Py_CLEAR(array);
    }
    return array;
}
