/* Records: the start values and the inputs of the episode of each instance. An instance that cannot
 * save its state returns to a step of its episode by playing it again. */

#ifndef FMUGYM_RECORDS_H
#define FMUGYM_RECORDS_H

#include "pool.h"

/* A copy of the record of an instance. */
typedef struct {
    RecordedStart *starts;
    size_t number_of_starts;
    double *inputs; /* of each step */
    size_t rows;
} Record;

/* Begins to keep records, with the next reset of each instance. Returns false if memory runs out. */
bool records_open(Pool *pool);
void records_close(Pool *pool);

/* The following four do nothing in a pool that keeps no records. A record that cannot be
 * continued, because memory runs out or the instance has left the episode, is dropped. */
void record_begin(Pool *pool, size_t index, const Access *start, const double *starts);
void record_add(Pool *pool, size_t index, const double *inputs);
void record_drop(Pool *pool, size_t index);
/* Adds the inputs of a run of instances, those of each after each other, but for those in the mask. */
void records_add(Pool *pool, size_t begin, size_t count, Mask mask, const double *inputs);

/* Whether no step of the episode is missing in the record. */
bool record_is_whole(const Pool *pool, size_t index);
/* Copies such a record. Returns false if memory runs out. The caller clears the copy in any case. */
bool record_copy(const Pool *pool, size_t index, Record *copy);
void record_clear(Record *copy);

#endif
