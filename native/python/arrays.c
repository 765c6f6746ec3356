#include "arrays.h"

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

bool numpy_look(Numpy *numpy, PyObject *empty) {
    PyObject *array = PyObject_CallFunction(empty, "((i))", 1);

    if (array == NULL) {
        return false;
    }
    numpy->empty = empty;
    numpy->class = (PyTypeObject *)Py_NewRef((PyObject *)Py_TYPE(array));
    numpy->looks_inside = knows_arrays(empty);
    Py_DECREF(array);
    return true;
}

void numpy_drop(Numpy *numpy) {
    Py_CLEAR(numpy->class);
}

/* Taking over */

static bool take_buffer_of(Maker *maker, const Py_buffer *b) {
    if (b->ndim > MOST_ARRAY_DIMENSIONS) {
        PyErr_SetString(PyExc_ValueError, "an array of results has too many dimensions");
        return false;
    }
    maker->size = (size_t)b->len;
    maker->dimensions = b->ndim;
    memcpy(maker->shape, b->shape, (size_t)b->ndim * sizeof *b->shape);
    memcpy(maker->strides, b->strides, (size_t)b->ndim * sizeof *b->strides);
    return true;
}

static bool measure(Maker *maker, const Numpy *numpy) {
    PyObject *array = PyObject_CallObject(numpy->empty, maker->arguments);
    Py_buffer buffer;

    if (array == NULL || PyObject_GetBuffer(array, &buffer, PyBUF_STRIDES) < 0) {
        Py_XDECREF(array);
        return false;
    }
    const bool taken = take_buffer_of(maker, &buffer);
    if (numpy->looks_inside && Py_TYPE(array) == numpy->class) {
        maker->flags = fields_of(array)->flags;
        maker->type = fields_of(array)->type;
    }
    PyBuffer_Release(&buffer);
    Py_DECREF(array);
    return taken;
}

bool maker_take(Maker *maker, const Numpy *numpy, PyObject *arguments) {
    if (!PyTuple_Check(arguments) || PyTuple_Size(arguments) != 2) {
        PyErr_SetString(PyExc_TypeError, "expected a tuple of shape and type");
        return false;
    }
    maker->arguments = Py_NewRef(arguments);
    return measure(maker, numpy);
}

void maker_drop(Maker *maker) {
    for (size_t k = 0; k < ROUNDS; k++) {
        Py_CLEAR(maker->made[k].array);
    }
    Py_CLEAR(maker->arguments);
}

/* Knowing arrays */

static bool has_form(const Maker *maker, const Fields *f) {
    const size_t lengths = (size_t)maker->dimensions * sizeof *maker->shape;

    return f->dimensions == maker->dimensions && f->type == maker->type &&
           memcmp(f->shape, maker->shape, lengths) == 0 &&
           memcmp(f->strides, maker->strides, lengths) == 0;
}

bool maker_knows(const Maker *maker, const Numpy *numpy, PyObject *object, char **memory) {
    if (!numpy->looks_inside || Py_TYPE(object) != numpy->class) {
        return false;
    }
    const Fields *f = fields_of(object);
    *memory = f->data;
    return f->base == NULL && f->flags == maker->flags && f->weak_references == NULL &&
           has_form(maker, f);
}

const char *maker_memory_of(const Maker *maker, const Numpy *numpy, PyObject *object) {
    const bool looks = numpy->looks_inside && Py_TYPE(object) == numpy->class;

    return looks && has_form(maker, fields_of(object)) ? fields_of(object)->data : NULL;
}

/* Whether an array is what it was when it was made, and nobody else holds it. */
static bool is_free(const Maker *maker, const Numpy *numpy, const Made *made) {
    char *memory;

    return made->array != NULL && Py_REFCNT(made->array) == 1 &&
           maker_knows(maker, numpy, made->array, &memory) && memory == made->memory;
}

/* Providing */

PyObject *maker_make(const Maker *maker, const Numpy *numpy, char **memory) {
    PyObject *array = PyObject_CallObject(numpy->empty, maker->arguments);
    Py_buffer buffer;

    if (array == NULL || maker_knows(maker, numpy, array, memory)) {
        return array;
    }
    if (PyObject_GetBuffer(array, &buffer, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) < 0) {
        Py_DECREF(array);
        return NULL;
    }
    *memory = buffer.buf;
    PyBuffer_Release(&buffer);
    return array;
}

PyObject *maker_provide(Maker *maker, const Numpy *numpy, char **memory) {
    for (size_t k = 0; k < ROUNDS; k++) {
        if (is_free(maker, numpy, &maker->made[k])) {
            *memory = maker->made[k].memory;
            return Py_NewRef(maker->made[k].array);
        }
    }
    PyObject *array = maker_make(maker, numpy, memory);
    if (array == NULL || !numpy->looks_inside) {
        return array;
    }
    Made *place = &maker->made[maker->oldest];
    PyObject *before = place->array;
    maker->oldest = (maker->oldest + 1) % ROUNDS;
    *place = (Made){.array = Py_NewRef(array), .memory = *memory};
    Py_XDECREF(before); /* may call back, and another step then replaces the new array */
    return array;
}
