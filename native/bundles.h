/* Bundles: serialized states of many instances, for any instances of the same FMU, in this pool or
 * in another one. */

#ifndef FMUGYM_BUNDLES_H
#define FMUGYM_BUNDLES_H

#include "pool.h"

/* Bytes that grow; the caller frees them. */
typedef struct {
    char *bytes;
    size_t size, room;
} Bundle;

/* Serialized states to restore. An empty one stands for an instance that could not be saved. */
typedef struct States {
    const char *bytes;
    const double *outputs; /* a row of count for each output of the pool */
    size_t count;
    int64_t *ends;    /* where the bytes of each state end */
    int64_t *steps;   /* its communication steps */
    const double *start_times;
    int64_t *sources; /* for each place in pool->chosen, which state its instance gets */
} States;

/* Appends the states of instances to a bundle. Returns the index of the first instance that fails,
 * or -1. An instance that cannot be stepped gets an empty state. */
ptrdiff_t pool_bundle(Pool *pool, const int64_t *indices, size_t count, Bundle *bundle,
                      int64_t *ends, int64_t *steps, double *start_times);

/* Restores the states in the first count instances of pool->chosen. Returns how many of them have
 * a status worse than a warning. */
size_t pool_unbundle(Pool *pool, const States *states, size_t count);

/* Restores a state in one instance; the outputs in the pool's array become those of the state. */
Status instance_unbundle(Pool *pool, Instance *me, const States *states, size_t number);

#endif
