/* The arrays that a step or a reset returns. */

#ifndef FMUGYM_RESULTS_H
#define FMUGYM_RESULTS_H

#include "pool/play.h"
#include "python/arrays.h"

/* After the arrays of observations and infos come those that only a step has (pool/play.h), then those
 * that only starts of episodes have, then those of the last observations and infos of episodes that end
 * where others start. */
enum { MASK_ARRAY = STEP_ARRAYS, DRAWN_ARRAY, LAST_ARRAYS };
enum { MOST_SEEN = MOST_ARRAYS - STEP_ARRAYS, RESULT_ARRAYS = 2 * MOST_SEEN + LAST_ARRAYS };

typedef struct {
    bool are_of_one; /* whether a number stands in the place of an array of one */
    size_t number_of_seen; /* arrays of observations and infos */
    Maker makers[RESULT_ARRAYS];
} Results;

/* The arrays of one step or reset, and their memory. */
typedef struct {
    PyObject *arrays[RESULT_ARRAYS];
    char *memory[RESULT_ARRAYS];
} ResultArrays;

/* Takes a tuple of patterns of each array: those of observations and infos, then rewards, terminated,
 * truncated, mask and drawn values. Returns false with an exception if it does not fit. The results must
 * be dropped in any case. */
bool results_take(Results *results, bool are_of_one, PyObject *patterns);
void results_drop(Results *results);

/* The place of an array after those of observations and infos. */
static inline size_t results_place(const Results *results, size_t other) {
    return results->number_of_seen + other;
}

/* Provides the arrays of a step or of a reset: new ones, or ones of an earlier call that nobody but
 * the results holds any more. Returns false with an exception if memory runs out. The caller releases
 * them in any case. */
bool results_provide_step(Results *results, ResultArrays *arrays);
bool results_provide_reset(Results *results, ResultArrays *arrays);
/* After results_provide_step: provides the mask and the drawn values of episodes that start. With at_ends
 * also the arrays of last observations and infos, filled with NaN or zeros. */
bool results_provide_starts(Results *results, bool at_ends, ResultArrays *arrays);
void results_release(const Results *results, ResultArrays *arrays);

/* Copies a mask to the array of the mask. Returns false if it is no array that this can be done
 * with, or has no true element. */
bool results_copy_mask(const Results *results, PyObject *mask, const ResultArrays *arrays);

/* Returns a tuple: how many environments had trouble; whether any episode is at its end now; rewards,
 * terminated and truncated; the arrays of observations and infos, a tuple; and None, or a tuple of where
 * episodes have started, what they have drawn, and None, or the last observations and infos where
 * episodes have ended in this step, in arrays of NaN, or of zeros. */
PyObject *results_of_step(const Results *results, const ResultArrays *arrays, size_t troubled,
                          bool any_ended, bool any_started, bool at_ends);
/* Returns a tuple: how many environments had trouble; whether any episode is at its end now; the arrays
 * of observations and infos; where episodes have started, and what they have drawn. */
PyObject *results_of_reset(const Results *results, const ResultArrays *arrays, size_t troubled,
                           bool any_ended);

#endif
