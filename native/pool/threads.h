/* Helper threads, shared by all pools of the process. */

#ifndef FMUGYM_THREADS_H
#define FMUGYM_THREADS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef struct {
    void (*work)(void *context, size_t begin, size_t end);
    void *context;
    size_t count;    /* items 0 to count - 1, at most 2^31 */
    size_t helpers;  /* maximum number of threads in addition to the caller */
    size_t smallest; /* smallest chunk in items, at least 1 */
    size_t largest;
    bool lasting; /* whether a single item takes much longer than to wake a helper */
    void (*look)(void); /* what the caller does now and then while it waits for the last chunks */
} Job;

/* Works through all items on the calling thread and on free helpers. Returns when all items are
 * done. Helpers are started when first needed. They stay asleep between jobs. */
void threads_run(const Job *job);

/* Counters of this process. */
typedef struct {
    uint64_t jobs;        /* jobs that helpers could join */
    uint64_t wakes;       /* wake-ups of sleeping helpers */
    uint64_t early_wakes; /* wake-ups before any item of the job was done */
    uint64_t chunks;      /* chunks of these jobs */
} ThreadStatistics;

ThreadStatistics threads_statistics(void);

/* Must be called once before anything else, and in the child after a fork, where no helpers
 * exist. */
void threads_reset(void);

#endif
