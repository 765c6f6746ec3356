/* The pace at which instances are made and initialized, for licences that limit it.
 * fmugym/pool/pacing.py explains it. */

#ifndef FMUGYM_PACE_H
#define FMUGYM_PACE_H

#include "platform.h"

typedef struct {
    uint64_t interval; /* from one call to the next in ns; 0 for no limit */
    Atomic *last;      /* when the last call began; several processes may share this memory */
} Pace;

/* Returns when the next call may begin, which is then taken. The clock is that of clock_now. */
uint64_t pace_claim(const Pace *pace);

/* Waits until a call may begin. */
void pace_wait(const Pace *pace);

#endif
