/* Infos of environments in Gymnasium's form, with their masks. */

#include "infos.h"

#include <string.h>

PyObject *infos_mask(const Origin *origin) {
    const size_t count = origin->mask_maker->size;
    char *memory;
    PyObject *mask = maker_make(origin->mask_maker, &memory);

    if (mask != NULL && origin->mask == NULL) {
        memset(memory, 1, count);
    } else if (mask != NULL) {
        memcpy(memory, origin->mask, count);
    }
    return mask;
}

/* Copies the rows of the environments in the mask. */
static void copy_rows(const Origin *origin, size_t number, char *memory) {
    const size_t count = origin->mask_maker->size, size = origin->makers[number].size / count;
    const char *const end = origin->mask + count;

    for (const char *at = origin->mask; (at = memchr(at, 1, (size_t)(end - at))) != NULL; at++) {
        const size_t place = (size_t)(at - origin->mask) * size;
        memcpy(memory + place, origin->memory[number] + place, size);
    }
}

static PyObject *value_of(const Origin *origin, size_t number) {
    const Maker *maker = &origin->makers[number];
    char *memory;

    if (origin->mask == NULL) {
        return Py_NewRef(origin->arrays[number]);
    }
    PyObject *value = maker_make(maker, &memory);
    if (value == NULL) {
        return NULL;
    }
    memset(memory, 0, maker->size);
    copy_rows(origin, number, memory);
    return value;
}

static PyObject *dict_of(const Origin *origin, const Form *form) {
    PyObject *dict = PyDict_New();

    if (dict != NULL && !infos_add(origin, form, dict)) {
        Py_CLEAR(dict);
    }
    return dict;
}

bool infos_add(const Origin *origin, const Form *form, PyObject *dict) {
    for (size_t i = 0; i < form->count; i++) {
        const Form *item = &form->items[i];
        PyObject *value =
            item->is_array ? value_of(origin, item->array) : dict_of(origin, item);
        if (!set_item(dict, item->name, value) ||
            !set_item(dict, item->name_of_mask, infos_mask(origin))) {
            return false;
        }
    }
    return true;
}

PyObject *infos_observations(const Origin *origin, const Form *form) {
    char *memory;

    if (form->is_array) {
        PyObject *array = maker_make_blank(&origin->makers[form->array], &memory);
        if (array != NULL) {
            copy_rows(origin, form->array, memory);
        }
        return array;
    }
    PyObject *dict = PyDict_New();
    for (size_t i = 0; i < form->count && dict != NULL; i++) {
        const Form *item = &form->items[i];
        if (!set_item(dict, item->name, infos_observations(origin, item))) {
            Py_CLEAR(dict);
        }
    }
    return dict;
}
