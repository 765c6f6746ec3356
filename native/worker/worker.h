/* A worker: a pool for a block of the instances of the process that has started it. It is the same
 * in a process that the extension serves and in the program for Windows. */

#ifndef FMUGYM_WORKER_H
#define FMUGYM_WORKER_H

#include "pool/pool_form.h"
#include "pool/requests.h"
#include "worker/frames.h"

/* The arrays that the process shares with its parent; see fmugym/pool/processes/shared_memory.py. They have
 * no gaps. */
typedef struct {
    char *base;
    size_t size;
    double *inputs, *outputs;
    float *observations;
    int8_t *statuses;
    const char *mask; /* the instances that a step leaves out, or that a start starts */
    int64_t *health;
} Shared;

/* A list of variables that are set before initialization, and its form. */
typedef struct {
    char *form;
    size_t size;
    Access access;
} List;

typedef struct {
    Channel channel;
    int memory; /* the descriptor of the shared memory until it is mapped; not used on Windows */
    int64_t process; /* its number: an FMU may have forked it */
    Opening opening; /* from here to resets all is of an opened pool */
    Pool pool;
    Shared shared;
    double *output_values;
    float *observations;
    int8_t *statuses;
    List *lists;
    size_t number_of_lists;
    int64_t resets;       /* of single instances */
    int64_t first_memory; /* bytes of the process after the first resets; 0 before */
} Worker;

/* Answers requests until one is to close, or the other end is gone. */
void worker_serve(Worker *worker);

/* Opens the pool as the content of the first request says. Returns whether that worked; if not, it has
 * told why. */
bool answer_open(Worker *worker, Reader *reader);

/* Starts episodes, inside of the pool. */
Answer answer_start(Worker *worker, Reader *reader, Writer *writer);

/* Passes on the messages of the FMUs. */
void worker_report(Worker *worker);
/* Copies outputs, observations and statuses to the shared memory. */
void worker_publish(Worker *worker);
/* The inputs of a step in the shared memory. */
Matrix shared_inputs(const Worker *worker);

/* Frees what the writer has. */
void send_answer(Worker *worker, Answer answer, Writer *writer);
void send_done(Worker *worker);
void send_error(Worker *worker, const char *text);

#endif
