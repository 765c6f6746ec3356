/* The data of an instance, which all sources share. */

#ifndef TYPES_H
#define TYPES_H

#include <stdbool.h>

#include "model.h"

/* Enumerations have the type Integer in FMI 1.0 and 2.0, and Int64 in FMI 3.0. */
#if FMI_VERSION == 3
typedef int64_t Integer;
#else
typedef int32_t Integer;
#endif

/* The values that the status types of all FMI versions share. */
typedef enum { STATUS_OK = 0, STATUS_DISCARD = 2, STATUS_ERROR = 3 } Status;

/* Each phase has its own bit, so that a mask stands for a set of phases. */
typedef enum {
    PHASE_INSTANTIATED = 1,
    PHASE_EXPERIMENT_SET_UP = 2,
    PHASE_INITIALIZATION = 4,
    PHASE_STEP = 8,
    PHASE_TERMINATED = 16
} Phase;

/* Everything that an FMU state contains. It has no pointers, so its bytes can be serialized. */
typedef struct {
    Reals reals;
    Constants constants;
    double stop_time; /* infinite if undefined */
    int32_t enumerations[NUMBER_OF_ENUMERATIONS];
    int32_t phase;
    int32_t stale;       /* something changed since the last refresh */
    int32_t step_status; /* of the last doStep */
} Simulation;

typedef struct {
    Simulation simulation;
    void *memory; /* the allocation that contains the instance */
    const char *name;
    uint32_t muted; /* log categories switched off: one bit per status */
} Instance;

/* Keeps rarely used code out of the way of the rest. */
#define RARE [[gnu::cold, gnu::noinline]]

#endif
