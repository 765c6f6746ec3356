/* Numbers of 16 bits, the binary16 of IEEE 754, which C does not have. */

#ifndef FMUGYM_HALVES_H
#define FMUGYM_HALVES_H

#include <stdbool.h>
#include <stdint.h>

typedef uint16_t Half;

float half_to_float(Half half);

/* Rounds to the nearest half, to the even one if two are as near. */
Half half_of(double value);

/* Infinities and NaNs are not finite. */
static inline bool half_is_finite(Half half) {
    return (half & 0x7c00) != 0x7c00;
}

static inline bool half_is_nan(Half half) {
    return (half & 0x7fff) > 0x7c00;
}

#endif
