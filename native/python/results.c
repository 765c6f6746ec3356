#include "results.h"

#include <stdlib.h>
#include <string.h>

/* The beginning of an array of numpy, as its C interface publishes it. knows_arrays compares it with
 * what numpy says of an array; where it differs, all arrays are new ones. */
typedef struct {
    char *data;
    int dimensions;
    Py_ssize_t *shape, *strides;
    PyObject *base, *type;
    int flags;
    PyObject *weak_references;
} Fields;

typedef struct {
    PyObject_HEAD Fields fields;
} Array;

/* An array that was made for a step, and what it was like then. Its holder may have changed its
 * shape, type or flags in place. */
typedef struct {
    PyObject *array;
    char *memory;
    Fields fields;
} Made;

enum {
    MOST_DIMENSIONS = 64, /* more than that numpy has none */
    ROUNDS = 2 /* callers often hold the arrays of one step while they take the next */
};

typedef struct {
    PyObject *arguments; /* of numpy.empty */
    size_t size;         /* in bytes */
    int dimensions;
    Py_ssize_t shape[MOST_DIMENSIONS], strides[MOST_DIMENSIONS];
    Made made[ROUNDS];
    unsigned oldest;
} Maker;

/* What is told of the episodes that a reset starts: dicts that are filled when somebody reads them. */
typedef struct {
    PyObject *name, *name_of_mask, *no_arguments;
    PyTypeObject *class;
    newfunc make;
    PyObject *unfilled, *slot, *fill, *plan;
} Telling;

struct Results {
    PyObject *parts, *empty, *names;
    PyTypeObject *class, *class_of_arrays;
    allocfunc allocate;
    Telling telling;
    bool looks_inside;
    size_t number_of_seen;
    Maker makers[RESULT_ARRAYS];
};

static const Fields *fields_of(PyObject *array) {
    return &((Array *)array)->fields;
}

/* Looking inside of arrays */

static bool has_room_for_fields(PyObject *array) {
    PyObject *size = PyObject_GetAttrString((PyObject *)Py_TYPE(array), "__basicsize__");
    const bool has = size != NULL && PyLong_AsSsize_t(size) >= (Py_ssize_t)sizeof(Array);

    Py_XDECREF(size);
    return has;
}

static bool equals_buffer(PyObject *array) {
    const Fields *f = fields_of(array);
    PyObject *type = PyObject_GetAttrString(array, "dtype");
    Py_buffer b;

    if (type == NULL || PyObject_GetBuffer(array, &b, PyBUF_STRIDES) < 0) {
        Py_XDECREF(type);
        return false;
    }
    const size_t lengths = (size_t)b.ndim * sizeof *b.shape;
    const bool equal = f->data == b.buf && f->dimensions == b.ndim && f->base == NULL &&
                       f->type == type && f->weak_references == NULL &&
                       memcmp(f->shape, b.shape, lengths) == 0 &&
                       memcmp(f->strides, b.strides, lengths) == 0;
    PyBuffer_Release(&b);
    Py_DECREF(type);
    return equal;
}

/* Whether the fields for flags and weak references show it when these change. */
static bool shows_changes(PyObject *array) {
    const int flags = fields_of(array)->flags;
    PyObject *reference = PyWeakref_NewRef(array, NULL);
    const bool shows_reference = reference != NULL && fields_of(array)->weak_references != NULL;
    PyObject *nothing = PyObject_CallMethod(array, "setflags", "i", 0);
    const bool shows_flags = nothing != NULL && fields_of(array)->flags != flags;

    Py_XDECREF(reference);
    Py_XDECREF(nothing);
    return shows_reference && shows_flags;
}

static bool knows_arrays(PyObject *empty) {
    PyObject *array = PyObject_CallFunction(empty, "((ii))", 2, 3);
    const bool knows = array != NULL && has_room_for_fields(array) && equals_buffer(array) &&
                       shows_changes(array);

    Py_XDECREF(array);
    PyErr_Clear();
    return knows;
}

/* Whether an array is what it was when it was made, and nobody else holds it. */
static bool is_free(const Maker *maker, const Made *made) {
    const size_t lengths = (size_t)maker->dimensions * sizeof *maker->shape;

    if (made->array == NULL || Py_REFCNT(made->array) != 1) {
        return false;
    }
    const Fields *now = fields_of(made->array), *then = &made->fields;
    return now->data == then->data && now->dimensions == then->dimensions &&
           now->base == NULL && now->type == then->type && now->flags == then->flags &&
           now->weak_references == NULL && memcmp(now->shape, maker->shape, lengths) == 0 &&
           memcmp(now->strides, maker->strides, lengths) == 0;
}

/* Taking over */

static bool take_buffer_of(Maker *maker, const Py_buffer *b) {
    if (b->ndim > MOST_DIMENSIONS) {
        return false;
    }
    maker->size = (size_t)b->len;
    maker->dimensions = b->ndim;
    memcpy(maker->shape, b->shape, (size_t)b->ndim * sizeof *b->shape);
    memcpy(maker->strides, b->strides, (size_t)b->ndim * sizeof *b->strides);
    return true;
}

static bool measure(Results *r, Maker *maker) {
    PyObject *array = PyObject_CallObject(r->empty, maker->arguments);
    Py_buffer buffer;

    if (array == NULL || PyObject_GetBuffer(array, &buffer, PyBUF_STRIDES) < 0) {
        Py_XDECREF(array);
        return false;
    }
    const bool taken = take_buffer_of(maker, &buffer);
    PyBuffer_Release(&buffer);
    Py_DECREF(array);
    if (!taken) {
        PyErr_SetString(PyExc_ValueError, "an array of results has too many dimensions");
    }
    return taken;
}

static bool take_makers(Results *r, PyObject *shapes) {
    const Py_ssize_t count = PyTuple_Size(shapes), judged = RESULT_ARRAYS - MOST_SEEN;

    if (count < judged || count > RESULT_ARRAYS) {
        PyErr_SetString(PyExc_ValueError, "results have too few or too many arrays");
        return false;
    }
    r->number_of_seen = (size_t)(count - judged);
    for (Py_ssize_t i = 0; i < count; i++) {
        const Py_ssize_t later = i - (count - judged);
        Maker *maker = &r->makers[later < 0 ? i : MOST_SEEN + later];
        maker->arguments = PyTuple_GetItem(shapes, i);
        if (!PyTuple_Check(maker->arguments)) {
            PyErr_SetString(PyExc_TypeError, "expected a tuple of shape and type");
            return false;
        }
        if (!measure(r, maker)) {
            return false;
        }
    }
    return true;
}

static bool take_names(Results *r, PyObject *names) {
    const bool fits = names == Py_None ? r->number_of_seen == 1
                                       : PyTuple_Check(names) &&
                                             (PyTuple_Size(names) == 0 ||
                                              (size_t)PyTuple_Size(names) == r->number_of_seen);
    r->names = names;
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "the names do not fit the arrays of observations");
    }
    return fits;
}

static bool take_class(Results *r) {
    r->allocate = (allocfunc)PyType_GetSlot(r->class, Py_tp_alloc);
    if (r->allocate == NULL || !PyType_IsSubtype(r->class, &PyTuple_Type)) {
        PyErr_SetString(PyExc_TypeError, "results must be tuples");
        return false;
    }
    return true;
}

static bool take_telling(Telling *t, PyObject *parts) {
    if (!PyArg_ParseTuple(parts, "UUO!UUOO;what is told of a reset", &t->name, &t->name_of_mask,
                          &PyType_Type, &t->class, &t->unfilled, &t->slot, &t->fill, &t->plan)) {
        return false;
    }
    t->make = (newfunc)PyType_GetSlot(t->class, Py_tp_new);
    t->no_arguments = PyTuple_New(0);
    if (t->make == NULL || !PyType_IsSubtype(t->class, &PyDict_Type)) {
        PyErr_SetString(PyExc_TypeError, "what is told of a reset must be a dict");
        return false;
    }
    return t->no_arguments != NULL;
}

/* Returns false with an exception if that is impossible. */
static bool look_at_arrays(Results *r) {
    PyObject *array = PyObject_CallFunction(r->empty, "((i))", 1);

    if (array == NULL) {
        return false;
    }
    r->class_of_arrays = (PyTypeObject *)Py_NewRef((PyObject *)Py_TYPE(array));
    r->looks_inside = knows_arrays(r->empty);
    Py_DECREF(array);
    return true;
}

static bool take_parts(Results *r, PyObject *parts) {
    PyObject *names, *shapes, *telling;

    return PyArg_ParseTuple(parts, "OO!OO!O!;results", &r->empty, &PyType_Type, &r->class, &names,
                            &PyTuple_Type, &shapes, &PyTuple_Type, &telling) &&
           take_class(r) && take_makers(r, shapes) && take_names(r, names) &&
           take_telling(&r->telling, telling) && look_at_arrays(r);
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
    for (size_t i = 0; i < RESULT_ARRAYS; i++) {
        for (size_t k = 0; k < ROUNDS; k++) {
            Py_XDECREF(r->makers[i].made[k].array);
        }
    }
    Py_XDECREF((PyObject *)r->class_of_arrays);
    Py_XDECREF(r->telling.no_arguments);
    Py_XDECREF(r->parts);
    free(r);
}

size_t results_number_of_seen(const Results *r) {
    return r->number_of_seen;
}

size_t results_size(const Results *r, size_t array) {
    return r->makers[array].size;
}

/* Providing */

static bool make(const Results *r, const Maker *maker, Made *made) {
    Py_buffer buffer;
    PyObject *array = PyObject_CallObject(r->empty, maker->arguments);

    if (array == NULL || PyObject_GetBuffer(array, &buffer, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) < 0) {
        Py_XDECREF(array);
        return false;
    }
    *made = (Made){.array = array, .memory = buffer.buf};
    if (r->looks_inside) {
        made->fields = *fields_of(array);
    }
    PyBuffer_Release(&buffer);
    return true;
}

/* Returns an array that the caller drops, or NULL with an exception. */
static PyObject *provide(const Results *r, Maker *maker, char **memory) {
    Made new;

    for (size_t k = 0; k < ROUNDS && r->looks_inside; k++) {
        if (is_free(maker, &maker->made[k])) {
            *memory = maker->made[k].memory;
            return Py_NewRef(maker->made[k].array);
        }
    }
    if (!make(r, maker, &new)) {
        return NULL;
    }
    *memory = new.memory;
    if (!r->looks_inside) {
        return new.array;
    }
    Made *place = &maker->made[maker->oldest];
    PyObject *before = place->array, *array = Py_NewRef(new.array);
    maker->oldest = (maker->oldest + 1) % ROUNDS;
    *place = new;
    Py_XDECREF(before); /* may call back, and another step then replaces the new array */
    return array;
}

static bool provide_some(Results *r, size_t begin, size_t end, ResultArrays *a) {
    for (size_t i = begin; i < end; i++) {
        a->arrays[i] = provide(r, &r->makers[i], &a->memory[i]);
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
}

bool results_provide_step(Results *r, ResultArrays *a) {
    clear(r, a);
    return provide_some(r, 0, r->number_of_seen, a) &&
           provide_some(r, REWARDS_ARRAY, TRUNCATED_ARRAY + 1, a);
}

bool results_provide_reset(Results *r, ResultArrays *a) {
    clear(r, a);
    return provide_some(r, 0, r->number_of_seen, a) &&
           provide_some(r, MASK_ARRAY, DRAWN_ARRAY + 1, a);
}

void results_drop(const Results *r, ResultArrays *a) {
    for (size_t i = 0; i < r->number_of_seen; i++) {
        Py_XDECREF(a->arrays[i]);
    }
    for (size_t i = MOST_SEEN; i < RESULT_ARRAYS; i++) {
        Py_XDECREF(a->arrays[i]);
    }
}

/* Whether an array of the caller is like the array of the mask. */
static bool is_mask(const Results *r, PyObject *array) {
    const Maker *own = &r->makers[MASK_ARRAY];

    if (!r->looks_inside || Py_TYPE(array) != r->class_of_arrays) {
        return false;
    }
    const Fields *f = fields_of(array);
    return f->type == PyTuple_GetItem(own->arguments, 1) && f->dimensions == 1 &&
           f->shape[0] == own->shape[0] && f->strides[0] == own->strides[0];
}

bool results_copy_mask(const Results *r, PyObject *mask, const ResultArrays *a) {
    const size_t size = r->makers[MASK_ARRAY].size;

    if (!is_mask(r, mask)) {
        return false;
    }
    memcpy(a->memory[MASK_ARRAY], fields_of(mask)->data, size);
    return memchr(a->memory[MASK_ARRAY], 1, size) != NULL;
}

/* Returning */

static PyObject *dict_of(const Results *r, const ResultArrays *a) {
    PyObject *dict = PyDict_New();

    for (size_t i = 0; i < r->number_of_seen && dict != NULL; i++) {
        if (PyDict_SetItem(dict, PyTuple_GetItem(r->names, (Py_ssize_t)i), a->arrays[i]) < 0) {
            Py_CLEAR(dict);
        }
    }
    return dict;
}

static PyObject *tuple_of(const Results *r, const ResultArrays *a) {
    PyObject *tuple = PyTuple_New((Py_ssize_t)r->number_of_seen);

    for (size_t i = 0; i < r->number_of_seen && tuple != NULL; i++) {
        PyTuple_SetItem(tuple, (Py_ssize_t)i, Py_NewRef(a->arrays[i]));
    }
    return tuple;
}

static PyObject *observations_of(const Results *r, const ResultArrays *a) {
    if (r->names == Py_None) {
        return Py_NewRef(a->arrays[0]);
    }
    return PyTuple_Size(r->names) == 0 ? tuple_of(r, a) : dict_of(r, a);
}

/* Makes the tuple without the constructor of its class, which takes several times as long. */
PyObject *results_of_step(const Results *r, const ResultArrays *a) {
    PyObject *observations = observations_of(r, a), *infos = PyDict_New();
    PyObject *result = observations == NULL || infos == NULL ? NULL : r->allocate(r->class, 5);

    if (result == NULL) {
        Py_XDECREF(observations);
        Py_XDECREF(infos);
        return NULL;
    }
    PyTuple_SetItem(result, 0, observations);
    for (Py_ssize_t i = 0; i < 3; i++) {
        PyTuple_SetItem(result, 1 + i, Py_NewRef(a->arrays[REWARDS_ARRAY + i]));
    }
    PyTuple_SetItem(result, 4, infos);
    return result;
}

/* A dict that calls a function, with these arguments, when somebody reads or writes it. */
static PyObject *late_dict(const Telling *t, PyObject *drawn, PyObject *mask) {
    PyObject *filling = PyTuple_Pack(4, t->fill, t->plan, drawn, mask);
    PyObject *dict = filling == NULL ? NULL : t->make(t->class, t->no_arguments, NULL);

    if (dict != NULL && (PyObject_SetAttr(dict, t->slot, filling) < 0 ||
                         PyDict_SetItem(dict, t->unfilled, Py_None) < 0)) {
        Py_CLEAR(dict);
    }
    Py_XDECREF(filling);
    return dict;
}

static PyObject *infos_of_reset(const Telling *t, const ResultArrays *a) {
    PyObject *mask = a->arrays[MASK_ARRAY], *drawn = late_dict(t, a->arrays[DRAWN_ARRAY], mask);
    PyObject *infos = drawn == NULL ? NULL : PyDict_New();

    if (infos != NULL && (PyDict_SetItem(infos, t->name, drawn) < 0 ||
                          PyDict_SetItem(infos, t->name_of_mask, mask) < 0)) {
        Py_CLEAR(infos);
    }
    Py_XDECREF(drawn);
    return infos;
}

PyObject *results_of_reset(const Results *r, const ResultArrays *a) {
    PyObject *infos = infos_of_reset(&r->telling, a);
    PyObject *observations = infos == NULL ? NULL : observations_of(r, a);
    PyObject *result = observations == NULL ? NULL : PyTuple_Pack(2, observations, infos);

    Py_XDECREF(observations);
    Py_XDECREF(infos);
    return result;
}
