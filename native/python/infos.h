/* Infos of environments in the form of Gymnasium's: arrays by name, each with a mask that says for
 * which environments it holds; see fmugym/vector/codec.py. */

#ifndef FMUGYM_INFOS_H
#define FMUGYM_INFOS_H

#include "arrays.h"
#include "forms.h"

typedef struct Infos Infos;

/* Takes the form of the infos, a dict, which must outlive the result, and how the arrays and a mask
 * are made. Returns NULL with an exception if memory runs out. */
Infos *infos_take(const Maker *arrays, size_t number_of_arrays, const Maker *mask,
                  const Form *form);
void infos_free(Infos *infos);

/* Adds the infos of all environments to a dict: the arrays themselves. Returns false with an
 * exception if memory runs out, as the next one does. */
bool infos_add(Infos *infos, PyObject *dict, PyObject *const *arrays);
/* Adds those of the environments in a mask: copies of the arrays, zero for the others. */
bool infos_add_masked(Infos *infos, PyObject *dict, char *const *memory, const char *mask);

#endif
