/* The form of observations or infos: an array, or a dict of such forms by name. */

#ifndef FMUGYM_FORMS_H
#define FMUGYM_FORMS_H

#include "python.h"

typedef struct Form Form;

struct Form {
    bool is_array;
    size_t array;                  /* its number */
    size_t count;                  /* of the items of a dict */
    Form *items;
    PyObject *name, *name_of_mask; /* in the dict that this is an item of */
};

/* Takes the number of an array, or a tuple of pairs, each a name and a form. Returns false with an
 * exception if it does not fit so many arrays; it must be dropped in any case. */
bool form_take(Form *form, PyObject *parts, size_t number_of_arrays);
void form_drop(Form *form);

/* Sets an item of a dict to an object, whose reference ends here. Returns false with an exception if
 * there is no object, or if memory runs out. */
bool set_item(PyObject *dict, PyObject *name, PyObject *object);

/* Returns the array, or a new dict of arrays; NULL with an exception if memory runs out. */
PyObject *form_of(const Form *form, PyObject *const *arrays);

#endif
