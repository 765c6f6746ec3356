/* What the instructions of a program do: one function for each kind of them. For the files that
 * evaluate programs. */

#ifndef FMUGYM_OPERATIONS_H
#define FMUGYM_OPERATIONS_H

#include <string.h>

#include "program/program.h"

/* A program at work on a run of environments. */
typedef struct {
    const Program *program;
    const Source *source;
    size_t begin, count;
    size_t lanes; /* count in whole blocks */
    Registers *registers;
    Notes *notes;
} Evaluation;

/* Sets the values after the last of a run to 0. Whole blocks are computed, and what an earlier run
 * has left there could be slow to compute with, or undefined to cast. */
static inline void clear_rest(void *values, size_t count, size_t lanes, size_t size) {
    if (count < lanes) {
        memset((char *)values + count * size, 0, (lanes - count) * size);
    }
}

/* moves.c: moves values between registers and memory that is not the program's. */
void operation_move(const Evaluation *e, Instruction i);

/* casts.c */
void operation_cast(uint16_t types, const void *from, size_t blocks, void *to);

/* look_ups.c: what is looked up outside of a table is noted, and becomes the first value. */
void operation_take(const Table *table, const int64_t *indices, size_t count, char *to,
                    Notes *notes);
void operation_interpolate(const Table *table, const double *x, size_t count, double *to);

/* arithmetic.c */
void operation_compute(uint16_t operation, const void *first, const void *second,
                       const void *third, size_t blocks, void *to);

/* functions.c: those of the C library, and what else takes longer. */
void operation_call(uint16_t operation, const void *first, const void *second, size_t count,
                    void *to);
void operation_turn(const double *angles, size_t count, double *sines, double *cosines);

#endif
