/* Infos of environments in the form of Gymnasium's: arrays by name, each with a mask that says for
 * which environments it holds; see fmugym/vector/codec.py. */

#ifndef FMUGYM_INFOS_H
#define FMUGYM_INFOS_H

#include "arrays.h"
#include "forms.h"

/* The arrays that infos are made of. */
typedef struct {
    const Maker *makers, *mask_maker;
    PyObject *const *arrays;
    char *const *memory;
    const char *mask; /* the environments; NULL for all */
} Origin;

/* Adds the arrays to a dict, or copies of them that are zero outside of the mask. Returns false with
 * an exception if memory runs out. */
bool infos_add(const Origin *origin, const Form *form, PyObject *dict);

/* Returns new arrays in the form of observations: those of the environments in the mask. Floats of others
 * are NaN. Returns NULL with an exception if memory runs out. */
PyObject *infos_observations(const Origin *origin, const Form *form);

/* Returns a copy of the mask, or NULL with an exception if memory runs out. */
PyObject *infos_mask(const Origin *origin);

#endif
