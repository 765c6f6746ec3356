/* Records: the start values and the inputs of the episode of each instance. An instance that cannot
 * save its state returns to a step of its episode by playing it again. */

#ifndef FMUGYM_RECORDS_H
#define FMUGYM_RECORDS_H

#include "pool.h"

/* Begins to keep records, with the next reset of each instance. Returns false if memory runs out. */
bool records_open(Pool *pool);
void records_close(Pool *pool);

/* The following three do nothing in a pool that keeps no records. A record that cannot be
 * continued, because memory runs out or the instance has left the episode, is dropped. */
void record_begin(Pool *pool, size_t index, const Access *start, const double *starts);
void record_add(Pool *pool, size_t index, const double *inputs);
void record_drop(Pool *pool, size_t index);

#endif
