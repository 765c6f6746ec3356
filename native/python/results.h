/* The arrays that a step or a reset returns, and the tuple and the dicts that they are in. */

#ifndef FMUGYM_RESULTS_H
#define FMUGYM_RESULTS_H

#include "python.h"
#include "program.h"

enum {
    REWARDS_ARRAY = MOST_SEEN,
    TERMINATED_ARRAY,
    TRUNCATED_ARRAY,
    MASK_ARRAY,
    DRAWN_ARRAY,
    RESULT_ARRAYS
};

typedef struct Results Results;

/* The arrays of one step or reset, and their memory. Those of observations and infos come first. If
 * episodes start where others end, there are more of these, for the last observations. */
typedef struct {
    PyObject *arrays[RESULT_ARRAYS], *last[MOST_SEEN];
    char *memory[RESULT_ARRAYS], *last_memory[MOST_SEEN];
} ResultArrays;

/* Takes a tuple: the class of a step's result; the forms of observations and of infos (see forms.h);
 * the shape and type of each array: those of observations and infos, then rewards, terminated,
 * truncated, mask and drawn values; and, for what infos tell of the episodes that start, the class
 * LateDict, the key of what fills it, and a function of drawn values and a mask that does so. None in
 * the place of these three makes results of a single environment: numbers for arrays of one. Returns
 * NULL with an exception if it does not fit. */
Results *results_take(PyObject *parts);
void results_free(Results *results);

/* Whether they are of a single environment. */
bool results_are_of_one(const Results *results);
size_t results_number_of_seen(const Results *results);
/* The bytes of an array. */
size_t results_size(const Results *results, size_t array);

/* Provides the arrays of a step or of a reset: new ones, or ones of an earlier call that nobody but
 * the results holds any more. Returns false with an exception if memory runs out. The caller drops
 * them in any case. */
bool results_provide_step(Results *results, ResultArrays *arrays);
bool results_provide_reset(Results *results, ResultArrays *arrays);
/* Provides, after results_provide_step, what it takes besides if episodes start; and if they do so
 * where others end. */
bool results_provide_starts(Results *results, bool at_ends, ResultArrays *arrays);
void results_drop(const Results *results, ResultArrays *arrays);

/* Copies a mask to the array of the mask. Returns false if it is no array that this can be done
 * with, or has no true element. */
bool results_copy_mask(const Results *results, PyObject *mask, const ResultArrays *arrays);

/* Returns the result of a step. If episodes have started where others have ended, the infos are those
 * of Gymnasium's mode SAME_STEP. */
PyObject *results_of_step(Results *results, const ResultArrays *arrays, bool any_started,
                          bool at_ends);
/* Returns the observations and infos of a reset. */
PyObject *results_of_reset(Results *results, const ResultArrays *arrays);

#endif
