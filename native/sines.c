/* Sines and cosines of the C library of GNU, without its functions for most values. Their error is
 * less than 0.55 units in the last place since version 2.28 (sysdeps/ieee754/dbl-64/s_sin.c). Here,
 * a result is known with an error below 0.05 units (0.04 at most in a comparison with 60 digits), as
 * a sum of two numbers. If the second one is
 * less than 0.4 units, every function with such errors rounds to the first one. The method is that
 * of W. J. Cody and W. Waite (1980), with the products of T. J. Dekker (1971). */

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <string.h>

#include "lanes.h"
#include "platform.h"
#include "quick.h"

/* The first 33 bits of half of pi, the next 33, and the rest. */
#define HALF_PI_1 0x1.921fb544p+0
#define HALF_PI_2 0x1.0b4611a6p-34
#define HALF_PI_3 0x1.3198a2e037073p-69

/* A number as the sum of two. */
typedef struct {
    double high, low;
} Pair;

/* The sum of two numbers, of which the first one is larger. */
static inline Pair sum_of(double a, double b) {
    const double high = a + b;
    return (Pair){high, b - (high - a)};
}

/* What the rounded product of two numbers lacks. */
static inline double lost(double a, double b, double product) {
    const double a1 = upper_half(a), a2 = a - a1, b1 = upper_half(b), b2 = b - b1;
    return ((a1 * b1 - product) + a1 * b2 + a2 * b1) + a2 * b2;
}

static inline Pair square_of(Pair r) {
    const double high = r.high * r.high;
    return (Pair){high, lost(r.high, r.high, high) + 2.0 * r.high * r.low};
}

/* x minus the nearest multiple of half of pi. */
static inline Pair reduced(double x, double count) {
    const double first = x - count * HALF_PI_1, second = count * HALF_PI_2;
    const double high = first - second, back = high - first;
    const double low = (first - (high - back)) - (second + back);
    return sum_of(high, low - count * HALF_PI_3);
}

/* Taylor's series from the fifth power on. */
static inline double rest_of_sine(double s) {
    return 1.0 / 120 +
           s * (-1.0 / 5040 +
                s * (1.0 / 362880 +
                     s * (-1.0 / 39916800 +
                          s * (1.0 / 6227020800 +
                               s * (-1.0 / 1307674368000 + s * (1.0 / 355687428096000))))));
}

/* Taylor's series from the fourth power on. */
static inline double rest_of_cosine(double s) {
    return 1.0 / 24 +
           s * (-1.0 / 720 +
                s * (1.0 / 40320 +
                     s * (-1.0 / 3628800 +
                          s * (1.0 / 479001600 +
                               s * (-1.0 / 87178291200 +
                                    s * (1.0 / 20922789888000 +
                                         s * (-1.0 / 6402373705728000)))))));
}

static inline Pair sine_of(Pair r, Pair s) {
    const double sixth = 1.0 / 6, missing = 1.0 / 108086391056891904; /* of the rounded 1 / 6 */
    const double part = s.high * sixth;
    const double part_low = lost(s.high, sixth, part) + s.high * missing + s.low * sixth;
    const double cube = part * r.high;
    const double cube_low = lost(part, r.high, cube) + part_low * r.high + part * r.low;
    const Pair first = sum_of(r.high, -cube);
    const double rest = r.high * (s.high * s.high) * rest_of_sine(s.high);
    return sum_of(first.high, first.low + (r.low - cube_low) + rest);
}

static inline Pair cosine_of(Pair s) {
    const Pair first = sum_of(1.0, -0.5 * s.high);
    const double small = first.low - 0.5 * s.low + s.high * s.low * (1.0 / 12);
    return sum_of(first.high, small + s.high * s.high * rest_of_cosine(s.high));
}

static inline uint64_t bits_of(double x) {
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

static inline double double_of(uint64_t bits) {
    double x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

/* One of two numbers, by a mask. */
static inline double chosen(uint64_t mask, double first, double second) {
    return double_of((bits_of(first) & mask) | (bits_of(second) & ~mask));
}

/* The sine and the cosine of the rest of x after a number of quarters of a turn. */
typedef struct {
    Pair sine, cosine;
    uint64_t quarter;
    bool is_usual; /* whether the pairs are as exact as promised */
} Wave;

static inline Wave wave_of(double x) {
    const double rounder = 0x1.8p52; /* adding it rounds to an integer, in the last bits */
    const double shifted = x * 0x1.45f306dc9c883p-1 + rounder, count = shifted - rounder;
    const Pair r = reduced(x, count), s = square_of(r);

    return (Wave){sine_of(r, s), cosine_of(s), bits_of(shifted),
                  (fabs(x) < 0x1p20) & (fabs(x) > 0x1p-500) &
                      ((fabs(r.high) > 0x1p-20) | (count == 0.0))};
}

/* The sine of a wave some quarters of a turn later. Notes whether it is doubtful: below a power of
 * two, the units are half as long. */
static inline uint8_t value_of(Wave wave, uint64_t later, double *to) {
    const uint64_t quarter = wave.quarter + later;
    const uint64_t is_cosine = -(quarter & 1), sign = (quarter & 2) << 62;
    const double high = chosen(is_cosine, wave.cosine.high, wave.sine.high);
    const double low = chosen(is_cosine, wave.cosine.low, wave.sine.low);
    const uint64_t bits = bits_of(high), leading = bits & UINT64_C(0x7ff) << 52;
    const double unit = DBL_EPSILON * double_of(leading);

    *to = double_of(bits ^ sign);
    return !((fabs(low) <= 0.4 * unit) & ((bits << 12) != 0) & wave.is_usual);
}

static inline void both_of(double x, double *sine, double *cosine, uint8_t *doubtful_sine,
                           uint8_t *doubtful_cosine) {
    const Wave wave = wave_of(x);
    *doubtful_sine = value_of(wave, 0, sine);
    *doubtful_cosine = value_of(wave, 1, cosine);
}

WIDE void quick_sine(const double *restrict x, size_t blocks, double *restrict to,
                     uint8_t *restrict doubtful) {
    EACH_LANE(doubtful[j] = value_of(wave_of(x[j]), 0, &to[j]));
}

WIDE void quick_cosine(const double *restrict x, size_t blocks, double *restrict to,
                       uint8_t *restrict doubtful) {
    EACH_LANE(doubtful[j] = value_of(wave_of(x[j]), 1, &to[j]));
}

WIDE void quick_sine_and_cosine(const double *restrict x, size_t blocks, double *restrict sine,
                                double *restrict cosine, uint8_t *restrict doubtful_sine,
                                uint8_t *restrict doubtful_cosine) {
    EACH_LANE(both_of(x[j], &sine[j], &cosine[j], &doubtful_sine[j], &doubtful_cosine[j]));
}
