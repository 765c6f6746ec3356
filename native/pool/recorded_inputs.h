/* Records: the start values and the inputs of the episode of each instance. An instance that cannot
 * save its state returns to a step of its episode by playing it again. */

#ifndef FMUGYM_RECORDED_INPUTS_H
#define FMUGYM_RECORDED_INPUTS_H

#include "pool/pool.h"

/* Begins to keep records, with the next reset of each instance. Returns false if memory runs out. */
bool records_open(Pool *pool);
void records_close(Pool *pool);

/* The following three do nothing in a pool that keeps no records. A record that cannot be
 * continued, because memory runs out or the instance has left the episode, is dropped. */
void record_begin(Pool *pool, size_t index, const Access *start, const double *starts);
void record_drop(Pool *pool, size_t index);
/* Adds the inputs of a run of instances, those of each after each other, but for those in the mask. */
void records_add(Pool *pool, size_t begin, size_t count, Mask mask, const double *inputs);

/* Whether no step of the episode is missing in the record. */
bool record_is_whole(const Pool *pool, size_t index);
/* The bytes of such a record: its start values, the texts of Strings, and the inputs of each row. Sets
 * how many values and rows there are. */
size_t record_size(const Pool *pool, size_t index, int64_t *starts, int64_t *rows);
void record_write(const Pool *pool, size_t index, char *to);
/* Whether so many bytes are a record with so many start values and rows, for a pool that keeps any. */
bool record_fits(const Pool *pool, int64_t starts, int64_t rows, const char *bytes, size_t size);
/* Lets the record of an instance be the one in such bytes. */
void record_put(Pool *pool, size_t index, size_t starts, size_t rows, const char *from);

#endif
