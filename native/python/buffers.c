/* Checks of the arrays of a caller: type, shape and alignment. */

#include "python/buffers.h"

#include <stdint.h>
#include <stdio.h>
#include <string.h>

typedef struct {
    const char *name;
    const char
        *formats; /* of the module struct; which of them has the size depends on the system */
    Py_ssize_t size;
} ItemType;

static const ItemType types[] = {
    [ITEM_FLOAT64] = {"float64", "d", 8}, [ITEM_FLOAT32] = {"float32", "f", 4},
    [ITEM_INT64] = {"int64", "lq", 8},    [ITEM_UINT64] = {"uint64", "LQ", 8},
    [ITEM_INT8] = {"int8", "b", 1},       [ITEM_BOOLEAN] = {"bool", "?", 1},
    [ITEM_FLOAT16] = {"float16", "e", 2}, [ITEM_INT16] = {"int16", "h", 2},
    [ITEM_INT32] = {"int32", "il", 4},    [ITEM_UINT8] = {"uint8", "B", 1},
    [ITEM_UINT16] = {"uint16", "H", 2},   [ITEM_UINT32] = {"uint32", "IL", 4},
};

static bool has_type(const Py_buffer *buffer, const ItemType *type) {
    const char *format = buffer->format == NULL ? "B" : buffer->format;

    if (*format == '@' || *format == '=') {
        format++;
    }
    return format[0] != '\0' && format[1] == '\0' && strchr(type->formats, format[0]) != NULL &&
           buffer->itemsize == type->size;
}

static bool has_shape(const Py_buffer *buffer, int dimensions, const Py_ssize_t *shape) {
    if (buffer->ndim != dimensions) {
        return false;
    }
    for (int i = 0; i < dimensions; i++) {
        if (shape[i] != ANY_LENGTH && buffer->shape[i] != shape[i]) {
            return false;
        }
    }
    return true;
}

static bool is_aligned(const Py_buffer *buffer) {
    return buffer->len == 0 || (uintptr_t)buffer->buf % (uintptr_t)buffer->itemsize == 0;
}

static void describe_shape(char *text, size_t size, int dimensions, const Py_ssize_t *shape) {
    size_t length = (size_t)snprintf(text, size, "(");

    for (int i = 0; i < dimensions && length < size; i++) {
        const char *comma = i == 0 ? "" : ", ";
        if (shape[i] == ANY_LENGTH) {
            length += (size_t)snprintf(text + length, size - length, "%sany", comma);
        } else {
            length += (size_t)snprintf(text + length, size - length, "%s%lld", comma,
                                       (long long)shape[i]);
        }
    }
    if (length < size) {
        snprintf(text + length, size - length, dimensions == 1 ? ",)" : ")");
    }
}

static void refuse_shape(const char *name, const Py_buffer *buffer, int dimensions,
                         const Py_ssize_t *shape) {
    char expected[80], actual[80];

    describe_shape(expected, sizeof expected, dimensions, shape);
    describe_shape(actual, sizeof actual, buffer->ndim, buffer->shape);
    PyErr_Format(PyExc_ValueError, "%s must have the shape %s, not %s", name, expected, actual);
}

Item item_of(const Py_buffer *buffer) {
    Item item = 0;

    while (item < ITEMS && !has_type(buffer, &types[item])) {
        item++;
    }
    return item;
}

bool buffer_fits(const Py_buffer *buffer, Use use, const char *name, Item item, int dimensions,
                 const Py_ssize_t *shape) {
    const ItemType *type = &types[item];

    if (!has_type(buffer, type)) {
        PyErr_Format(PyExc_TypeError, "%s must be an array of %s, not of type '%s' with %zd bytes",
                     name, type->name, buffer->format == NULL ? "B" : buffer->format,
                     buffer->itemsize);
    } else if (!has_shape(buffer, dimensions, shape)) {
        refuse_shape(name, buffer, dimensions, shape);
    } else if (use != COPIED && !is_aligned(buffer)) {
        PyErr_Format(PyExc_ValueError, "%s must begin at a multiple of %zd bytes", name,
                     type->size);
    } else {
        return true;
    }
    return false;
}

static bool take_buffer(PyObject *object, Py_buffer *buffer, Use use, const char *name, Item item,
                        int dimensions, const Py_ssize_t *shape) {
    static const int flags[] = {[COPIED] = PyBUF_STRIDES,
                                [IN_PLACE] = PyBUF_C_CONTIGUOUS,
                                [WRITTEN] = PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE};
    if (PyObject_GetBuffer(object, buffer, flags[use] | PyBUF_FORMAT) < 0) {
        return false;
    }
    if (!buffer_fits(buffer, use, name, item, dimensions, shape)) {
        PyBuffer_Release(buffer);
        return false;
    }
    return true;
}

bool take_vector(PyObject *object, Py_buffer *buffer, Use use, const char *name, Item item,
                 Py_ssize_t length) {
    return take_buffer(object, buffer, use, name, item, 1, &length);
}

bool take_matrix(PyObject *object, Py_buffer *buffer, Use use, const char *name, Item item,
                 Py_ssize_t rows, Py_ssize_t columns) {
    const Py_ssize_t shape[] = {rows, columns};
    return take_buffer(object, buffer, use, name, item, 2, shape);
}

void release_buffer(Py_buffer *buffer) {
    if (buffer->obj != NULL) {
        PyBuffer_Release(buffer);
    }
}
