/* The step of a single environment: its compiled hooks before and after the step of the only
 * instance. Whatever is rare is left to Python. */

#ifndef FMUGYM_SINGLE_H
#define FMUGYM_SINGLE_H

#include "pool.h"
#include "program.h"

/* A row of episode variables, and the same as it was before the step. */
typedef struct {
    char *now, *before;
    size_t size; /* in bytes */
} KeptRow;

/* The owner provides all memory. */
typedef struct {
    Program inputs;    /* from the next action to the wanted inputs */
    Program judgement; /* its results are done, truncated, reward; it stores the rest */
    Registers *input_registers, *judgement_registers;
    char *next, *current, *previous; /* actions: of this step, of the last, of the one before */
    size_t elements, size;           /* of an action; bytes of an element */
    double *wanted, *inputs_row;     /* inputs that were not checked yet, and those of the pool */
    double *kept;                    /* the outputs before the step */
    const KeptRow *rows;
    size_t number_of_rows;
    char *const *seen; /* the arrays of the observation that the judgement stores */
    bool observed;     /* whether the pool makes the observation, of float32 */
    int64_t *step_count;
    int64_t limit; /* steps after which an episode is truncated */
} Single;

typedef enum {
    SINGLE_DONE,
    SINGLE_REFUSED, /* the inputs are not finite: nothing has changed */
    SINGLE_TROUBLED /* the instance has stepped, but the result needs a closer look */
} SingleOutcome;

typedef struct {
    bool terminated, truncated;
    double reward;
} SingleResult;

/* Steps the instance. The result only counts if it is SINGLE_DONE. */
SingleOutcome single_step(Pool *pool, const Single *single, const Call *call,
                          SingleResult *result);

/* The two parts of it, around a step that is done elsewhere. The first returns false instead of
 * SINGLE_REFUSED. The second takes how many instances had trouble in the step. */
bool single_before(const Pool *pool, const Single *single);
SingleOutcome single_after(const Pool *pool, const Single *single, size_t troubled,
                           SingleResult *result);

#endif
