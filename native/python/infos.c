#include "infos.h"

#include <stdlib.h>
#include <string.h>

/* Makers of the masks of one item: of all environments, and of some. */
typedef struct {
    Maker all, some;
} Masks;

struct Infos {
    const Form *form;
    size_t number_of_arrays, number_of_items, count;
    Maker *values; /* of each array */
    Masks *masks;
};

/* Where infos come from. */
typedef struct {
    PyObject *const *arrays; /* for all environments; NULL if there is a mask */
    char *const *memory;
    const char *mask;
    size_t item; /* the number of the next one, in the order of the form */
} Origin;

/* Taking over */

static size_t count_items(const Form *form) {
    size_t number = form->count;

    for (size_t i = 0; i < form->count; i++) {
        number += count_items(&form->items[i]);
    }
    return number;
}

static bool take_values(Infos *in, const Form *form, const Maker *arrays) {
    if (form->is_array && in->values[form->array].type == NULL) {
        return maker_take_part(&in->values[form->array], &arrays[form->array], 0);
    }
    for (size_t i = 0; i < form->count; i++) {
        if (!take_values(in, &form->items[i], arrays)) {
            return false;
        }
    }
    return true;
}

static bool take_masks(Infos *in, const Maker *mask) {
    for (size_t i = 0; i < in->number_of_items; i++) {
        if (!maker_take_part(&in->masks[i].all, mask, 0) ||
            !maker_take_part(&in->masks[i].some, mask, 0)) {
            return false;
        }
    }
    return true;
}

Infos *infos_take(const Maker *arrays, size_t number_of_arrays, const Maker *mask,
                  const Form *form) {
    Infos *in = calloc(1, sizeof *in);

    if (in == NULL) {
        PyErr_NoMemory();
        return NULL;
    }
    *in = (Infos){.form = form,
                  .number_of_arrays = number_of_arrays,
                  .number_of_items = count_items(form),
                  .count = mask->size};
    in->values = calloc(in->number_of_arrays + 1, sizeof *in->values);
    in->masks = calloc(in->number_of_items + 1, sizeof *in->masks);
    if (in->values == NULL || in->masks == NULL) {
        PyErr_NoMemory();
    } else if (take_values(in, form, arrays) && take_masks(in, mask)) {
        return in;
    }
    infos_free(in);
    return NULL;
}

void infos_free(Infos *in) {
    if (in == NULL) {
        return;
    }
    for (size_t i = 0; i < in->number_of_arrays && in->values != NULL; i++) {
        maker_drop(&in->values[i]);
    }
    for (size_t i = 0; i < in->number_of_items && in->masks != NULL; i++) {
        maker_drop(&in->masks[i].all);
        maker_drop(&in->masks[i].some);
    }
    free(in->values);
    free(in->masks);
    free(in);
}

/* Making */

static PyObject *mask_of(Infos *in, const Origin *origin) {
    Masks *masks = &in->masks[origin->item];
    Maker *maker = origin->mask == NULL ? &masks->all : &masks->some;
    char *memory;
    PyObject *mask = maker_provide(maker, &memory);

    if (mask != NULL && origin->mask == NULL) {
        memset(memory, 1, maker->size);
    } else if (mask != NULL) {
        memcpy(memory, origin->mask, maker->size);
    }
    return mask;
}

static PyObject *value_of(Infos *in, size_t number, const Origin *origin) {
    Maker *maker = &in->values[number];
    char *memory;

    if (origin->mask == NULL) {
        return Py_NewRef(origin->arrays[number]);
    }
    PyObject *value = maker_provide(maker, &memory);
    if (value == NULL) {
        return NULL;
    }
    const size_t size = maker->size / in->count;
    const char *const end = origin->mask + in->count;
    memset(memory, 0, maker->size);
    for (const char *at = origin->mask; (at = memchr(at, 1, (size_t)(end - at))) != NULL; at++) {
        const size_t place = (size_t)(at - origin->mask) * size;
        memcpy(memory + place, origin->memory[number] + place, size);
    }
    return value;
}

static bool add_items(Infos *in, const Form *form, Origin *origin, PyObject *dict);

static PyObject *dict_of(Infos *in, const Form *form, Origin *origin) {
    PyObject *dict = PyDict_New();

    if (dict != NULL && !add_items(in, form, origin, dict)) {
        Py_CLEAR(dict);
    }
    return dict;
}

static PyObject *item_of(Infos *in, const Form *form, Origin *origin) {
    return form->is_array ? value_of(in, form->array, origin) : dict_of(in, form, origin);
}

static bool add_items(Infos *in, const Form *form, Origin *origin, PyObject *dict) {
    for (size_t i = 0; i < form->count; i++) {
        const Form *item = &form->items[i];
        PyObject *mask = mask_of(in, origin);
        origin->item++;
        if (mask == NULL || !set_item(dict, item->name, item_of(in, item, origin))) {
            Py_XDECREF(mask);
            return false;
        }
        if (!set_item(dict, item->name_of_mask, mask)) {
            return false;
        }
    }
    return true;
}

bool infos_add(Infos *in, PyObject *dict, PyObject *const *arrays) {
    Origin origin = {.arrays = arrays};

    return add_items(in, in->form, &origin, dict);
}

bool infos_add_masked(Infos *in, PyObject *dict, char *const *memory, const char *mask) {
    Origin origin = {.memory = memory, .mask = mask};

    return add_items(in, in->form, &origin, dict);
}
