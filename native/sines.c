/* Sines and cosines of the C library of GNU, without its functions for most values. Their error is
 * less than 0.55 units in the last place since version 2.28 (sysdeps/ieee754/dbl-64/s_sin.c). Here,
 * a result is known with an error below 0.02 units (0.019 at most in 20 million comparisons with
 * numbers of 113 bits), as a sum of two numbers. If the second one is at most 0.43 units, every
 * function with such errors rounds to the first one. The method is that of W. J. Cody and W. Waite
 * (1980), with the products of T. J. Dekker (1971). */

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <string.h>

#include "lanes.h"
#include "platform.h"
#include "quick.h"

/* Products whose rounding error comes from one instruction are known as exactly, in half the time.
 * The helpers are part of loops for both kinds of processors. */
#if defined __x86_64__ && defined __linux__ && defined __GLIBC__ && !defined __SANITIZE_THREAD__
#define CAN_FUSE
#define INLINED static inline __attribute__((always_inline))
#define FUSED __builtin_fma
#else
#define INLINED static inline
#define FUSED fma
#endif

/* The first 33 bits of half of pi, the next 33, and the rest. */
#define HALF_PI_1 0x1.921fb544p+0
#define HALF_PI_2 0x1.0b4611a6p-34
#define HALF_PI_3 0x1.3198a2e037073p-69

/* A number as the sum of two. */
typedef struct {
    double high, low;
} Pair;

/* The sum of two numbers, of which the first one is larger. */
INLINED Pair sum_of(double a, double b) {
    const double high = a + b;
    return (Pair){high, b - (high - a)};
}

/* What the rounded product of two numbers lacks: the same number in both ways, unless it is too small
 * for one. The first way needs a processor that multiplies and adds at once. */
INLINED double part_lost(double a, double b, double product, bool fused) {
    if (fused) {
        return FUSED(a, b, -product);
    }
    const double a1 = upper_half(a), a2 = a - a1, b1 = upper_half(b), b2 = b - b1;
    return ((a1 * b1 - product) + a1 * b2 + a2 * b1) + a2 * b2;
}

INLINED Pair square_of(Pair r, bool fused) {
    const double high = r.high * r.high;
    return (Pair){high, part_lost(r.high, r.high, high, fused) + 2.0 * r.high * r.low};
}

/* x minus the nearest multiple of half of pi. */
INLINED Pair reduced(double x, double count) {
    const double first = x - count * HALF_PI_1, second = count * HALF_PI_2;
    const double high = first - second, back = high - first;
    const double low = (first - (high - back)) - (second + back);
    return sum_of(high, low - count * HALF_PI_3);
}

/* Taylor's series from the fifth power on. */
INLINED double rest_of_sine(double s) {
    return 1.0 / 120 +
           s * (-1.0 / 5040 +
                s * (1.0 / 362880 +
                     s * (-1.0 / 39916800 +
                          s * (1.0 / 6227020800 +
                               s * (-1.0 / 1307674368000 + s * (1.0 / 355687428096000))))));
}

/* Taylor's series from the sixth power on. */
INLINED double rest_of_cosine(double s) {
    return -1.0 / 720 +
           s * (1.0 / 40320 +
                s * (-1.0 / 3628800 +
                     s * (1.0 / 479001600 +
                          s * (-1.0 / 87178291200 +
                               s * (1.0 / 20922789888000 +
                                    s * (-1.0 / 6402373705728000))))));
}

INLINED Pair sine_of(Pair r, Pair s, bool fused) {
    const double sixth = 1.0 / 6, missing = 1.0 / 108086391056891904; /* of the rounded 1 / 6 */
    const double part = s.high * sixth;
    const double part_low = part_lost(s.high, sixth, part, fused) + s.high * missing + s.low * sixth;
    const double cube = part * r.high;
    const double cube_low = part_lost(part, r.high, cube, fused) + part_low * r.high + part * r.low;
    const Pair first = sum_of(r.high, -cube);
    const double rest = r.high * (s.high * s.high) * rest_of_sine(s.high);
    return sum_of(first.high, first.low + (r.low - cube_low) + rest);
}

INLINED Pair cosine_of(Pair s, bool fused) {
    const double part = 1.0 / 24, missing = 1.0 / 432345564227567616; /* of the rounded 1 / 24 */
    const Pair square = square_of(s, fused);
    const double fourth = square.high * part;
    const double fourth_low =
        part_lost(square.high, part, fourth, fused) + square.high * missing + square.low * part;
    const Pair first = sum_of(1.0, -0.5 * s.high), second = sum_of(first.high, fourth);
    const double rest = s.high * square.high * rest_of_cosine(s.high);
    return sum_of(second.high,
                  second.low + (first.low - 0.5 * s.low + fourth_low) + rest);
}

INLINED uint64_t bits_of(double x) {
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

INLINED double double_of(uint64_t bits) {
    double x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

/* One of two numbers, by a mask. */
INLINED double chosen(uint64_t mask, double first, double second) {
    return double_of((bits_of(first) & mask) | (bits_of(second) & ~mask));
}

/* The sine and the cosine of the rest of x after a number of quarters of a turn. */
typedef struct {
    Pair sine, cosine;
    uint64_t quarter;
    bool is_usual; /* whether the pairs are as exact as promised */
} Wave;

INLINED Wave wave_of(double x, bool fused) {
    const double rounder = 0x1.8p52; /* adding it rounds to an integer, in the last bits */
    const double shifted = x * 0x1.45f306dc9c883p-1 + rounder, count = shifted - rounder;
    const Pair r = reduced(x, count), s = square_of(r, fused);

    return (Wave){sine_of(r, s, fused), cosine_of(s, fused), bits_of(shifted),
                  (fabs(x) < 0x1p20) & (fabs(x) > 0x1p-500) &
                      ((fabs(r.high) > 0x1p-20) | (count == 0.0))};
}

/* The sine of a wave some quarters of a turn later. Notes whether it is doubtful: below a power of
 * two, the units are half as long. */
INLINED int64_t value_of(Wave wave, uint64_t later, double *to) {
    const uint64_t quarter = wave.quarter + later;
    const uint64_t is_cosine = -(quarter & 1), sign = (quarter & 2) << 62;
    const double high = chosen(is_cosine, wave.cosine.high, wave.sine.high);
    const double low = chosen(is_cosine, wave.cosine.low, wave.sine.low);
    const uint64_t bits = bits_of(high), leading = bits & UINT64_C(0x7ff) << 52;
    const double unit = DBL_EPSILON * double_of(leading);

    *to = double_of(bits ^ sign);
    return !((fabs(low) <= 0.43 * unit) & ((bits << 12) != 0) & wave.is_usual);
}

INLINED void both_of(double x, bool fused, double *sine, double *cosine, int64_t *doubtful_sine,
                     int64_t *doubtful_cosine) {
    const Wave wave = wave_of(x, fused);
    *doubtful_sine = value_of(wave, 0, sine);
    *doubtful_cosine = value_of(wave, 1, cosine);
}

#define FUNCTIONS(attribute, way, fused)                                                           \
    attribute static void sine_##way(const double *restrict x, size_t blocks, double *restrict to, \
                                     int64_t *restrict doubtful) {                                 \
        EACH_LANE(doubtful[j] = value_of(wave_of(x[j], fused), 0, &to[j]));                        \
    }                                                                                              \
    attribute static void cosine_##way(const double *restrict x, size_t blocks,                    \
                                       double *restrict to, int64_t *restrict doubtful) {          \
        EACH_LANE(doubtful[j] = value_of(wave_of(x[j], fused), 1, &to[j]));                        \
    }                                                                                              \
    attribute static void both_##way(const double *restrict x, size_t blocks,                      \
                                     double *restrict sine, double *restrict cosine,               \
                                     int64_t *restrict doubtful_sine,                              \
                                     int64_t *restrict doubtful_cosine) {                          \
        EACH_LANE(both_of(x[j], fused, &sine[j], &cosine[j], &doubtful_sine[j],                    \
                          &doubtful_cosine[j]));                                                   \
    }

FUNCTIONS(WIDE, rounded, false)

#ifdef CAN_FUSE
FUNCTIONS(__attribute__((target("avx2,fma"))), fused, true)
#define CHOICE(name)                                                                               \
    (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? name##_fused                \
                                                                     : name##_rounded)
#else
#define CHOICE(name) name##_rounded
#endif

void quick_sine(const double *x, size_t blocks, double *to, int64_t *doubtful) {
    CHOICE(sine)(x, blocks, to, doubtful);
}

void quick_cosine(const double *x, size_t blocks, double *to, int64_t *doubtful) {
    CHOICE(cosine)(x, blocks, to, doubtful);
}

void quick_sine_and_cosine(const double *x, size_t blocks, double *sine, double *cosine,
                           int64_t *doubtful_sine, int64_t *doubtful_cosine) {
    CHOICE(both)(x, blocks, sine, cosine, doubtful_sine, doubtful_cosine);
}
