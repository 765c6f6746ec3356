#include "quick.h"

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <string.h>

#include "lanes.h"
#include "platform.h"

/* The power of 2, by a loop whose error is less than 0.515 units in the last place if the square is
 * between 2^-32 and 2^32. Dekker's product gives the error of the rounded square. Where it is less
 * than 0.485 units, no such loop can round in the other direction. Below a power of two the units
 * are half as long; the loop handles those. */
static inline int64_t square_one(double x, double *square) {
    const double high = upper_half(x), low = x - high, rounded = x * x;
    const double error = ((high * high - rounded) + 2.0 * high * low) + low * low;
    uint64_t bits, leading;
    double power;

    memcpy(&bits, &rounded, sizeof bits);
    leading = bits & UINT64_C(0x7ff) << 52;
    memcpy(&power, &leading, sizeof power);
    *square = rounded;
    return !((fabs(error) <= 0.485 * DBL_EPSILON * power) & (bits != leading) &
             (rounded > 0x1p-32) & (rounded < 0x1p32));
}

WIDE void quick_square(const double *restrict x, size_t blocks, double *restrict to,
                       int64_t *restrict doubtful) {
    EACH_LANE(doubtful[j] = square_one(x[j], &to[j]));
}

/* The remainder of numpy: that of the C library, which is exact, plus the divisor if the signs
 * differ. A quotient of few digits makes both parts of its product with the divisor exact, and so
 * are their differences from x, if the first one is. The rest after the nearest quotient is at most
 * about half of the divisor; it needs no more digits than x and the divisor have. */
static inline int64_t remainder_one(double x, double y, double *remainder) {
    const double rounder = 0x1.8p52; /* adding it rounds to an integer */
    const double ratio = x / y, quotient = (ratio + rounder) - rounder;
    const double high = upper_half(y), product = quotient * high;
    const double difference = x - product, back = difference - x;
    const double lost = (x - (difference - back)) - (product + back);
    const double rest = difference - quotient * (y - high);
    const double missing = rest * y < 0.0 ? y : 0.0;

    *remainder = copysign(rest + missing, y);
    return !((fabs(ratio) < 0x1p26) & (lost == 0.0) & (fabs(y) > 1e-140) & (fabs(y) < 1e140) &
             ((fabs(rest) > 1e-140) | (rest == 0.0)));
}

WIDE void quick_remainder(const double *restrict x, const double *restrict y, size_t blocks,
                          double *restrict to, int64_t *restrict doubtful) {
    EACH_LANE(doubtful[j] = remainder_one(x[j], y[j], &to[j]));
}
