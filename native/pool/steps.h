/* Steps of one instance, and reading its outputs. */

#ifndef FMUGYM_STEPS_H
#define FMUGYM_STEPS_H

#include "pool/failures.h"
#include "pool/pool.h"

/* Scratch memory of one thread. */
typedef struct {
    double *values; /* values of one instance */
    void *typed;    /* the same values in their C types */
    double *inputs; /* inputs of a run of instances, one instance after the other */
    double *outputs;
    bool sound; /* whether these inputs are all finite */
} Scratch;

/* Uses the same order of operations as PoolSpec.communication_point. Division by 1 changes
 * nothing. */
static inline double instance_time(const Pool *pool, const Instance *me) {
    const Settings *s = &pool->settings;
    const double since_start = (double)me->steps * s->time_step;
    return me->start_time +
           (s->substeps == 1 ? since_start : since_start / (double)s->substeps);
}

/* Takes the start time of its next episode from its start values; without one, that of the pool. */
static inline void instance_set_start_time(const Pool *pool, Instance *me, const Access *start,
                                           const double *values) {
    me->start_time =
        start->start_time < 0 ? pool->settings.experiment.start_time : values[start->start_time];
}

static inline void instance_count_from(Instance *me, int64_t steps) {
    me->steps = me->counted = steps;
}

/* Sets the inputs, does a step and reads the outputs into the scratch memory. */
Status instance_step(Pool *pool, Instance *me, Scratch scratch);
/* Does the substeps of a step. */
Status instance_advance(Pool *pool, Instance *me);
/* Reads the outputs between two steps into the pool's array, if they are finite. Integrals over a
 * step are 0 there. */
Status instance_read_outputs(Pool *pool, Instance *me, Scratch scratch);
/* Copies the outputs from the pool's array. */
void instance_copy_outputs(const Pool *pool, const Instance *me, double *values);

Status instance_fail_step(Pool *pool, Instance *me, double time, Status status);
Status instance_fail_setting(Pool *pool, Instance *me, Status status);
Status instance_fail_reading(Pool *pool, Instance *me, Status status);

/* Magnitudes up to this one become finite when rounded to a float32. */
#define FLOAT32_LIMIT 0x1.fffffefffffffp+127

bool are_finite(const double *values, size_t count);
/* Whether no magnitude is greater than the limit; none is NaN. */
bool all_within(const double *values, size_t count, double limit);
/* Copies a column of a matrix. */
void matrix_gather(const Matrix *matrix, size_t column, size_t rows, double *values);

extern const char *const BAD_OUTPUTS;

#endif
