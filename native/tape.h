/* A tape: an episode of the first instance, as it happens in training. A fresh instance can then
 * play the same episode. When to record is counted, never measured. */

#ifndef FMUGYM_TAPE_H
#define FMUGYM_TAPE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "access.h"
#include "platform.h"

enum { TAPE_ROWS = 64 };

typedef enum { TAPE_OFF, TAPE_WAITING, TAPE_RECORDING, TAPE_READY } TapeState;

typedef struct {
    uint8_t state;
    Atomic ready;       /* whether a recording waits to be taken */
    int64_t resets;     /* of the first instance, while waiting */
    int64_t due_resets; /* how many it takes until the next recording */
    int64_t due_steps;  /* the steps of the first instance that it takes as well */
    int64_t position;   /* communication steps of the episode that are on the tape */
    size_t rows;        /* steps on the tape */
    size_t width_in, width_out, number_of_starts;
    uint8_t *start_types;
    Element *start_variables;
    double *starts;        /* the values of the start variables */
    double *first_outputs; /* the outputs before the first step */
    double *inputs, *outputs;
    int8_t *statuses;
} Tape;

/* Lets an episode be recorded once the first instance has done so many more resets, and so many
 * steps in all. */
void tape_wait(Tape *tape, int64_t resets, int64_t steps);

/* To be called at each reset of the first instance. Ends a recording that has a step. Returns
 * whether a recording is to begin now. */
bool tape_turn(Tape *tape, int64_t steps);

/* Begins a recording, except for first_outputs. Returns false if memory runs out. */
bool tape_begin(Tape *tape, const Access *start, const double *starts, size_t width_in,
                size_t width_out, int64_t position);
/* Records a step, after which the episode has so many communication steps. */
void tape_add(Tape *tape, const double *inputs, const double *outputs, int status,
              int64_t position);
/* Gives up a recording, because the episode was left in another way than by a reset. */
void tape_drop(Tape *tape);
void tape_free(Tape *tape);

#endif
