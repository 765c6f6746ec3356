/* Functions whose results are known without a loop of numpy, but for a few doubtful values. */

#ifndef FMUGYM_QUICK_H
#define FMUGYM_QUICK_H

#include <stddef.h>
#include <stdint.h>

/* All compute blocks of PROGRAM_BLOCK values, and note which of them are doubtful: 1 or 0, as wide as
 * the values, so that the compiler need not keep many of them in registers to pack the notes. */
void quick_square(const double *x, size_t blocks, double *to, int64_t *doubtful);
void quick_remainder(const double *x, const double *y, size_t blocks, double *to,
                     int64_t *doubtful);
void quick_sine(const double *x, size_t blocks, double *to, int64_t *doubtful);
void quick_cosine(const double *x, size_t blocks, double *to, int64_t *doubtful);
void quick_sine_and_cosine(const double *x, size_t blocks, double *sine, double *cosine,
                           int64_t *doubtful_sine, int64_t *doubtful_cosine);

#endif
