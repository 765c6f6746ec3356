/* The pace at which instances are made and initialized, for licences that limit it.
 * fmugym/pool/pacing.py explains it and does the same in Python. */

#ifndef FMUGYM_PACE_H
#define FMUGYM_PACE_H

#include "platform.h"

typedef struct {
    uint64_t interval; /* length of a slot in ns; 0 for no limit */
    uint64_t turn, turns; /* of turns processes, this one has the slots whose remainder is turn */
    Atomic next; /* the first slot that is free */
} Pace;

/* Waits for the next free slot. */
void pace_wait(Pace *pace);

#endif
