/* States as values: bytes that fit any instance of the same FMU, in this pool or in another one. They
 * are a head, the outputs, and what the kind of the head says. */

#ifndef FMUGYM_STATES_H
#define FMUGYM_STATES_H

#include "forms/writer.h"
#include "pool/pool.h"

typedef enum {
    KIND_ENDED, /* nothing: the instance could not be stepped any more */
    KIND_STATE, /* the bytes of the FMU */
    KIND_RECORD /* the record of the episode, see recorded_inputs.h */
} StateKind;

/* fmugym/pool/states.py has the same. */
typedef struct {
    int64_t kind;
    int64_t steps; /* communication steps */
    double start_time;
    int64_t starts, rows; /* of a record */
} StateHead;

typedef struct State {
    const char *bytes;
    size_t size;
} State;

/* Writes the states of instances, or their records, a block for each. Returns the index of the first
 * instance that fails, or -1. */
ptrdiff_t pool_save_states(Pool *pool, const int64_t *indices, size_t count, bool records,
                           Writer *writer);

/* Whether a state is whole, and of a kind that the pool can restore. */
bool state_is_sound(const Pool *pool, State state);
/* Restores sound states in the first count instances of pool->chosen, or those of a snapshot. A record only tells what the
 * episode of an instance was that is where it leads to. Returns how many of them have a status worse
 * than a warning. */
size_t pool_restore(Pool *pool, const State *states, const Snapshot *snapshot, size_t count);
/* Restores the state of one instance. */
Status instance_take_state(Pool *pool, Instance *me, State state);

#endif
