/* Functions whose results are known without a loop of numpy, but for a few doubtful values. */

#ifndef FMUGYM_QUICK_H
#define FMUGYM_QUICK_H

#include <stddef.h>
#include <stdint.h>

/* All compute blocks of PROGRAM_BLOCK values, and note which of them are doubtful. */
void quick_square(const double *x, size_t blocks, double *to, uint8_t *doubtful);
void quick_remainder(const double *x, const double *y, size_t blocks, double *to,
                     uint8_t *doubtful);
void quick_sine(const double *x, size_t blocks, double *to, uint8_t *doubtful);
void quick_cosine(const double *x, size_t blocks, double *to, uint8_t *doubtful);
void quick_sine_and_cosine(const double *x, size_t blocks, double *sine, double *cosine,
                           uint8_t *doubtful_sine, uint8_t *doubtful_cosine);

#endif
