/* The observations of single environments whose episodes have ended, as Gymnasium's mode SAME_STEP has
 * them. */

#ifndef FMUGYM_ENDS_H
#define FMUGYM_ENDS_H

#include "arrays.h"
#include "forms.h"

/* Makes an array of objects: the observations of some environments, None for the others. Of these
 * arrays and of the arrays in them, those that nobody else holds are used again. */
typedef struct Observed Observed;

/* Takes how the arrays are made that hold the observations of all environments, and the form of
 * observations, which must outlive the result. Returns NULL with an exception if memory runs out. */
Observed *observed_take(const Maker *arrays, size_t number_of_arrays, size_t count,
                        const Form *form);
void observed_free(Observed *observed);

/* Returns the array of objects, or NULL with an exception if memory runs out. The mask says which
 * environments; the arrays are those of all environments, with their memory. */
PyObject *observed_of(Observed *observed, const char *mask, PyObject *const *arrays,
                      char *const *memory);

#endif
