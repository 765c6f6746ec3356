/* A task: what a call does, and what its threads note down on the way. */

#ifndef FMUGYM_TASK_H
#define FMUGYM_TASK_H

#include "pool/states.h"
#include "pool/steps.h"
#include "program/program.h"

/* Runs: neighbouring instances whose inputs and outputs are moved together, in loops that become
 * vector instructions. */
enum { RUN = PROGRAM_WIDTH /* number of instances in a run */ };

static inline size_t length_of_run(size_t first, size_t end) {
    return end - first < RUN ? end - first : RUN;
}

/* What a call does; all threads that work on it write to its last fields. */
typedef struct {
    Pool *pool;
    const Call *call;
    int operation;
    const State *states;      /* to restore, one for each place in pool->chosen */
    const Snapshot *snapshot; /* or NULL */
    bool listed;              /* items are places in pool->chosen, otherwise instances */
    bool measured;
    _Alignas(CACHE_LINE) Atomic troubled; /* instances with a status worse than a warning */
    Atomic ended;                         /* episodes that have ended, when playing */
    Atomic started;                       /* those of them whose next episode has started */
    Atomic outside;                       /* threads that saw an index outside of a table */
    Atomic time;                          /* total ns of all threads, if measured */
} Task;

/* Keeps the status of an instance. Returns 1 if it is worse than a warning. */
size_t note_status(Task *task, size_t index, Status status);

/* Writes the first outputs of an instance. */
void write_observation(const Pool *pool, size_t index, float *observations);
void write_all_observations(const Pool *pool, float *observations);

#endif
