/* A worker: a pool for a block of the instances of the process that has started it. */

#ifndef FMUGYM_WORKER_H
#define FMUGYM_WORKER_H

#include "../pool.h"
#include "frames.h"

/* The block's part of the arrays that the processes share; see
 * fmugym/pool/process/shared_memory.py. Rows of inputs and outputs are stride elements apart, and
 * the others have no gaps. */
typedef struct {
    char *base;
    uint64_t size;
    size_t stride;
    double *inputs, *outputs;
    float *observations;
    int8_t *statuses;
    const char *mask;
    int64_t *health;
} Shared;

/* A list of variables that the other process refers to by a number. */
typedef struct {
    int64_t number;
    Access access;
} List;

typedef struct {
    Pool pool;
    Settings settings;
    Access inputs, outputs;
    Shared shared;
    double *output_values;
    float *observations;
    int8_t *statuses;
    List *lists;
    size_t number_of_lists;
    Snapshot **snapshots; /* NULL for those that were freed */
    size_t number_of_snapshots;
    int64_t resets;       /* of single instances */
    int64_t first_memory; /* bytes of the process after the first resets; 0 before */
} Worker;

/* Opens the pool as the content of the first request says, which must stay in place. Returns
 * whether that worked; if not, error says why. */
bool worker_open(Worker *worker, Reader *reader, char *error, size_t size);

/* Reads a list of variables: a block of their types, and a block of their value references. */
bool read_access(Reader *reader, const Fmi *fmi, Access *access);

/* Passes on the messages of the FMUs. */
void worker_report(Worker *worker);

/* Copies outputs, observations and statuses to the shared memory. */
void worker_publish(Worker *worker);

/* Answers a request. Returns whether the worker goes on. */
bool worker_answer(Worker *worker, Reader *reader);
void worker_release(Worker *worker, Reader *reader);
void worker_step(Worker *worker, bool some);

#endif
