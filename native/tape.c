#include "tape.h"

#include <stdlib.h>
#include <string.h>

void tape_wait(Tape *tape, int64_t resets, int64_t steps) {
    tape->state = TAPE_WAITING;
    tape->resets = 0;
    tape->due_resets = resets;
    tape->due_steps = steps;
}

static void finish(Tape *tape) {
    tape->state = TAPE_READY;
    atomic_set(&tape->ready, 1);
}

bool tape_turn(Tape *tape, int64_t steps) {
    if (tape->state == TAPE_RECORDING && tape->rows > 0) {
        finish(tape);
        return false;
    }
    tape->resets++;
    return tape->state == TAPE_RECORDING ||
           (tape->state == TAPE_WAITING && tape->resets >= tape->due_resets &&
            steps >= tape->due_steps);
}

static void release(Tape *tape) {
    free(tape->start_types);
    free(tape->start_variables);
    free(tape->starts);
    free(tape->first_outputs);
    free(tape->inputs);
    free(tape->outputs);
    free(tape->statuses);
    tape->start_types = NULL;
    tape->start_variables = NULL;
    tape->starts = tape->first_outputs = tape->inputs = tape->outputs = NULL;
    tape->statuses = NULL;
}

static bool allocate(Tape *tape) {
    tape->start_types = calloc(tape->number_of_starts + 1, sizeof *tape->start_types);
    tape->start_variables = calloc(tape->number_of_starts + 1, sizeof *tape->start_variables);
    tape->starts = calloc(tape->number_of_starts + 1, sizeof *tape->starts);
    tape->first_outputs = calloc(tape->width_out + 1, sizeof *tape->first_outputs);
    tape->inputs = calloc(TAPE_ROWS * tape->width_in + 1, sizeof *tape->inputs);
    tape->outputs = calloc(TAPE_ROWS * tape->width_out + 1, sizeof *tape->outputs);
    tape->statuses = calloc(TAPE_ROWS, sizeof *tape->statuses);
    return tape->start_types != NULL && tape->start_variables != NULL && tape->starts != NULL &&
           tape->first_outputs != NULL && tape->inputs != NULL && tape->outputs != NULL &&
           tape->statuses != NULL;
}

static void note_starts(Tape *tape, const Access *start, const double *starts) {
    memcpy(tape->start_types, start->types, start->count);
    memcpy(tape->start_variables, start->variables, start->count * sizeof *start->variables);
    memcpy(tape->starts, starts, start->count * sizeof *starts);
}

bool tape_begin(Tape *tape, const Access *start, const double *starts, size_t width_in,
                size_t width_out, int64_t position) {
    release(tape);
    tape->rows = 0;
    tape->width_in = width_in;
    tape->width_out = width_out;
    tape->number_of_starts = start->count;
    tape->position = position;
    if (!allocate(tape)) {
        tape_free(tape);
        return false;
    }
    note_starts(tape, start, starts);
    tape->state = TAPE_RECORDING;
    return true;
}

void tape_add(Tape *tape, const double *inputs, const double *outputs, int status,
              int64_t position) {
    const size_t row = tape->rows;

    if (position == tape->position) { /* the call has only reset the instance, or skipped it */
        return;
    }
    memcpy(tape->inputs + row * tape->width_in, inputs, tape->width_in * sizeof *inputs);
    memcpy(tape->outputs + row * tape->width_out, outputs, tape->width_out * sizeof *outputs);
    tape->statuses[row] = (int8_t)status;
    tape->position = position;
    if (++tape->rows == TAPE_ROWS) {
        finish(tape);
    }
}

void tape_drop(Tape *tape) {
    if (tape->state == TAPE_RECORDING) {
        tape->state = TAPE_WAITING;
    }
}

void tape_free(Tape *tape) {
    release(tape);
    tape->state = TAPE_OFF;
    atomic_set(&tape->ready, 0);
}
