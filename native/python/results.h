/* The arrays that a step returns, and the tuple and the dicts that they are in. */

#ifndef FMUGYM_RESULTS_H
#define FMUGYM_RESULTS_H

#include "python.h"
#include "program.h"

enum { REWARDS_ARRAY = MOST_SEEN, TERMINATED_ARRAY, TRUNCATED_ARRAY, RESULT_ARRAYS };

typedef struct Results Results;

/* The arrays of one step, and their memory. Those of observations and infos come first. */
typedef struct {
    PyObject *arrays[RESULT_ARRAYS];
    char *memory[RESULT_ARRAYS];
} StepArrays;

/* Takes a tuple: the function numpy.empty; the class of a step's result; what the observations are,
 * an array (None), a dict (the tuple of its keys) or a tuple of arrays that the caller replaces (an
 * empty tuple); and the shape and type of each array: those of observations and infos, then rewards,
 * terminated and truncated. Returns NULL with an exception if it does not fit. */
Results *results_take(PyObject *parts);
void results_free(Results *results);

size_t results_number_of_seen(const Results *results);
/* The bytes of an array. */
size_t results_size(const Results *results, size_t array);

/* Provides arrays for a step: new ones, or ones of an earlier step that nobody but the results
 * holds any more. Returns false with an exception if memory runs out. The caller drops them in any
 * case. */
bool results_provide(Results *results, StepArrays *arrays);
void results_drop(const Results *results, StepArrays *arrays);

/* Returns the result of a step, with an empty dict of infos. */
PyObject *results_make(const Results *results, const StepArrays *arrays);

#endif
