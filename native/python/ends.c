#include "ends.h"

#include <stdlib.h>
#include <string.h>

#include "program.h"

enum { MOST_KEPT = 1 << 20, /* bytes of arrays that wait for their next use */
       SIZE_OF_ARRAY = 128  /* an array of numpy without its memory, about */ };

/* The part of a single environment in one array. */
typedef struct {
    Maker maker;
    size_t size;    /* in bytes */
    bool is_scalar; /* then it is no array, and no maker is there */
} PartMaker;

struct Observed {
    size_t count;
    const Form *form;
    Maker objects;
    PartMaker parts[MOST_SEEN];
    PyObject **spare; /* arrays that nobody else holds, where an observation is one */
    size_t number_of_spare, most;
};

/* Taking over */

static bool take_part(PartMaker *part, const Maker *all, size_t count) {
    part->size = count > 0 ? all->size / count : 0;
    part->is_scalar = all->dimensions == 1;
    return part->is_scalar || maker_take_part(&part->maker, all, 1);
}

static bool take_spare(Observed *o) {
    const size_t most = MOST_KEPT / (o->parts[0].size + SIZE_OF_ARRAY);

    o->most = o->form->is_array && most < o->count ? most : o->form->is_array ? o->count : 0;
    o->spare = calloc(o->most + 1, sizeof *o->spare);
    if (o->spare == NULL) {
        PyErr_NoMemory();
    }
    return o->spare != NULL;
}

static bool take_objects(Observed *o) {
    PyObject *arguments = Py_BuildValue("((n)s)", (Py_ssize_t)o->count, "O");
    const bool taken = arguments != NULL && maker_take(&o->objects, arguments);

    Py_XDECREF(arguments);
    return taken;
}

Observed *observed_take(const Maker *arrays, size_t number_of_arrays, size_t count,
                        const Form *form) {
    Observed *o = calloc(1, sizeof *o);

    if (o == NULL) {
        PyErr_NoMemory();
        return NULL;
    }
    o->count = count;
    o->form = form;
    bool good = take_objects(o);
    for (size_t i = 0; i < number_of_arrays && good; i++) {
        good = take_part(&o->parts[i], &arrays[i], count);
    }
    if (!good || !take_spare(o)) {
        observed_free(o);
        return NULL;
    }
    return o;
}

void observed_free(Observed *o) {
    if (o == NULL) {
        return;
    }
    maker_drop(&o->objects);
    for (size_t i = 0; i < MOST_SEEN; i++) {
        maker_drop(&o->parts[i].maker);
    }
    while (o->number_of_spare > 0) {
        Py_DECREF(o->spare[--o->number_of_spare]);
    }
    free(o->spare);
    free(o);
}

/* Takes back what an array of objects has held. */
static void clear(Observed *o, PyObject **objects) {
    char *memory;

    for (size_t i = 0; i < o->count; i++) {
        PyObject *object = objects[i];
        if (object == Py_None) {
            continue; /* nearly all of them */
        }
        objects[i] = Py_NewRef(Py_None); /* first, because the end of an object may call back */
        if (object != NULL && Py_REFCNT(object) == 1 && o->number_of_spare < o->most &&
            maker_knows(&o->parts[0].maker, object, &memory)) {
            o->spare[o->number_of_spare++] = object;
        } else {
            Py_XDECREF(object);
        }
    }
}

/* Filling */

static PyObject *array_of(Observed *o, const Maker *maker, char **memory) {
    while (o->number_of_spare > 0) {
        PyObject *spare = o->spare[--o->number_of_spare];
        if (maker_knows(maker, spare, memory)) {
            return spare;
        }
        Py_DECREF(spare);
    }
    return maker_make(maker, memory);
}

static PyObject *part_of(Observed *o, size_t number, size_t index, PyObject *all,
                         const char *memory_of_all) {
    const PartMaker *part = &o->parts[number];
    char *memory;

    if (part->is_scalar) {
        return PySequence_GetItem(all, (Py_ssize_t)index);
    }
    PyObject *array = array_of(o, &part->maker, &memory);
    if (array != NULL) {
        memcpy(memory, memory_of_all + index * part->size, part->size);
    }
    return array;
}

static PyObject *seen_by(Observed *o, const Form *form, size_t index, PyObject *const *arrays,
                         char *const *memory) {
    const size_t array = form->array;

    if (form->is_array) {
        return part_of(o, array, index, arrays[array], memory[array]);
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
