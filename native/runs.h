/* Runs: neighbouring instances whose inputs and outputs are moved together, in loops that become
 * vector instructions. */

#ifndef FMUGYM_RUNS_H
#define FMUGYM_RUNS_H

#include "bundles.h"
#include "pool.h"
#include "steps.h"

enum { RUN = PROGRAM_WIDTH /* number of instances in a run */ };

/* What a call does; all threads that work on it write to its last fields. */
typedef struct {
    Pool *pool;
    const Call *call;
    int operation;
    const Snapshot *snapshot; /* the snapshot to restore */
    const States *states;     /* or the serialized states */
    bool listed;              /* items are places in pool->chosen, otherwise instances */
    bool measured;
    _Alignas(CACHE_LINE) Atomic troubled; /* instances with a status worse than a warning */
    Atomic ended;                         /* episodes that have ended, when playing */
    Atomic outside;                       /* threads that saw an index outside of a table */
    Atomic started;                       /* those of them whose next episode has started */
    Atomic time;                          /* total ns of all threads, if measured */
} Task;

static inline bool is_in(Mask mask, size_t index) {
    return mask.data != NULL && mask.data[(ptrdiff_t)index * mask.stride] != 0;
}

static inline size_t length_of_run(size_t first, size_t end) {
    return end - first < RUN ? end - first : RUN;
}

/* All three work on the items from begin to end and return how many instances have a status
 * worse than a warning. This one resets or restores instances that need not be neighbours: */
size_t run_listed(Task *task, size_t begin, size_t end, Scratch scratch);
/* This one steps or resets: */
size_t run_steps(Task *task, size_t begin, size_t end, Scratch scratch);
/* This one does the same and runs the programs before and after: */
size_t run_play(Task *task, size_t begin, size_t end, Scratch scratch);

/* Keeps the status of an instance. Returns 1 if it is worse than a warning. */
size_t note_status(Task *task, size_t index, Status status);

/* Writes the first outputs of an instance. */
void write_observation(const Pool *pool, size_t index, float *observations);

#endif
