/* Helper threads, shared by all pools of the process. */

#ifndef FMUGYM_THREADS_H
#define FMUGYM_THREADS_H

#include <stddef.h>
#include <stdint.h>

typedef struct {
    void (*work)(void *context, size_t begin, size_t end);
    void *context;
    size_t count;    /* items 0 to count - 1, at most 2^31 */
    size_t helpers;  /* at most so many threads besides the caller */
    size_t smallest; /* chunk, in items, at least 1 */
    size_t largest;
} Job;

/* Works through all items, on the calling thread and on helpers that come free, and returns when
 * all are done. Helpers are started when first asked for and then kept, asleep. */
void threads_run(const Job *job);

/* What has happened in this process. */
typedef struct {
    uint64_t jobs;   /* that helpers could take part in */
    uint64_t wakes;  /* of helpers that slept */
    uint64_t chunks; /* of these jobs */
} ThreadStatistics;

ThreadStatistics threads_statistics(void);

/* To be called once before anything else, and in the child after a fork, which has no helpers. */
void threads_reset(void);

#endif
