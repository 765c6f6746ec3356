/* Mathematical functions of programs: powers, remainders and turns. */

#include "program/operations.h"

#include <math.h>

#include "shared/platform.h"

#define EACH(Type, expression)                                                                     \
    {                                                                                              \
        const Type *x = first, *y = second;                                                        \
        Type *r = to;                                                                              \
        (void)y;                                                                                   \
        for (size_t j = 0; j < count; j++) {                                                       \
            r[j] = (expression);                                                                   \
        }                                                                                          \
    }                                                                                              \
    break

#define OF_ONE(operation, function)                                                                \
    case operation:                                                                                \
        EACH(double, function(x[j]))
#define OF_TWO(operation, function)                                                                \
    case operation:                                                                                \
        EACH(double, function(x[j], y[j]))

/* Lets the C library compute what a loop of arithmetic has left. */
#define EACH_LEFT(expression)                                                                      \
    for (size_t j = 0; j < count; j++) {                                                           \
        if (is_left[j]) {                                                                          \
            r[j] = (expression);                                                                   \
        }                                                                                          \
    }

/* What x * x is more than its rounded product, by Dekker's halves: exact, or not a number where x is
 * too great for it. */
static inline double rest_of_square(double x, double product) {
    const double scaled = 0x1.0000002p27 * x, high = scaled - (scaled - x), low = x - high;
    return ((high * high - product) + 2.0 * high * low) + low * low;
}

/* Whether a power function that is off by less than slack before it rounds returns the product. */
static inline bool is_sure(double product, double rest, double slack) {
    return (product + (rest + slack) == product) & (product + (rest - slack) == product);
}

/* Multiplies what is to be squared, and notes where a power may differ from that product. */
WIDE static void square_most(const double *restrict x, const double *restrict y, size_t count,
                             double *restrict r, uint8_t *restrict is_left) {
    for (size_t j = 0; j < count; j++) {
        const double product = x[j] * x[j], rest = rest_of_square(x[j], product);
        const bool is_usual = (product > 0x1p-64) & (product < 0x1p64);
        r[j] = product;
        is_left[j] = !((y[j] == 2.0) & is_usual & is_sure(product, rest, 0x1p-57 * product));
    }
}

/* Powers of the C library. Its squares are not always the rounded product, but nine of ten must be: its
 * results are off by less than 0.53 units in the last place. In the usual range it is 0.514 for that
 * of glibc, musl and Android, by the formula in its source. */
static void operation_raise(const double *x, const double *y, size_t count, double *r) {
    uint8_t is_left[PROGRAM_WIDTH];

    square_most(x, y, count, r, is_left);
    EACH_LEFT(pow(x[j], y[j]));
}

/* The product of two floats is exact as a double. */
WIDE static void square_most32(const float *restrict x, const float *restrict y, size_t count,
                               float *restrict r, uint8_t *restrict is_left) {
    for (size_t j = 0; j < count; j++) {
        const double product = (double)x[j] * x[j], slack = 0x1p-28 * product;
        const float low = (float)(product - slack), high = (float)(product + slack);
        const bool is_usual = (product > 0x1p-16) & (product < 0x1p16);
        r[j] = low;
        is_left[j] = !((y[j] == 2.0F) & is_usual & (low == high));
    }
}

/* The same for floats. Those libraries compute them as doubles; in the usual range, the results are off
 * by less than 0.55 units. */
static void operation_raise32(const float *x, const float *y, size_t count, float *r) {
    uint8_t is_left[PROGRAM_WIDTH];

    square_most32(x, y, count, r, is_left);
    EACH_LEFT(powf(x[j], y[j]));
}

/* The remainder of numpy has the sign of the divisor. */
static double remainder_of(double x, double y) {
    const double rest = fmod(x, y);

    if (rest == 0.0) {
        return copysign(rest, y);
    }
    return (rest < 0.0) != (y < 0.0) ? rest + y : rest;
}

/* Where the quotient is less than 2, one exact difference makes the remainder. Compilers vectorize this
 * if zeros are left. */
WIDE static void divide_most(const double *restrict x, const double *restrict y, size_t count,
                             double *restrict r, uint8_t *restrict is_left) {
    for (size_t j = 0; j < count; j++) {
        const double size = fabs(x[j]), divisor = fabs(y[j]), less = size - divisor;
        const double rest = copysign(less < 0.0 ? size : less, x[j]);
        r[j] = rest + (copysign(1.0, rest) * y[j] < 0.0 ? y[j] : 0.0);
        is_left[j] = !((less < divisor) & (rest != 0.0));
    }
}

static void operation_remain(const double *x, const double *y, size_t count, double *r) {
    uint8_t is_left[PROGRAM_WIDTH];

    divide_most(x, y, count, r, is_left);
    EACH_LEFT(remainder_of(x[j], y[j]));
}

/* What numpy rounds the quotient to, so that it fits the remainder. */
static double floor_divide(double x, double y) {
    const double rest = fmod(x, y), ratio = x / y;
    const bool is_lower = rest != 0.0 && (rest < 0.0) != (y < 0.0);
    const double quotient = (x - rest) / y - is_lower, whole = floor(quotient);

    if (y == 0.0) {
        return ratio;
    }
    if (quotient == 0.0) {
        return copysign(0.0, ratio);
    }
    return quotient - whole > 0.5 ? whole + 1.0 : whole;
}

/* Of two integers numpy makes 0 where the divisor is 0. The smallest integer has no opposite. */
static int64_t remainder_of_whole(int64_t x, int64_t y) {
    const int64_t rest = y == 0 || y == -1 ? 0 : x % y;
    return rest != 0 && (rest < 0) != (y < 0) ? rest + y : rest;
}

static int64_t floor_divide_whole(int64_t x, int64_t y) {
    if (y == 0 || y == -1) {
        return y == 0 ? 0 : (int64_t)(0 - (uint64_t)x);
    }
    return x / y - (x % y != 0 && (x < 0) != (y < 0));
}

void operation_call(uint16_t operation, const void *first, const void *second, size_t count,
                    void *to) {
    switch (operation) {
        OF_ONE(SIN, sin);
        OF_ONE(COS, cos);
        OF_ONE(TAN, tan);
        OF_ONE(ARCSIN, asin);
        OF_ONE(ARCCOS, acos);
        OF_ONE(ARCTAN, atan);
        OF_ONE(SINH, sinh);
        OF_ONE(COSH, cosh);
        OF_ONE(TANH, tanh);
        OF_ONE(ARCSINH, asinh);
        OF_ONE(ARCCOSH, acosh);
        OF_ONE(ARCTANH, atanh);
        OF_ONE(EXP, exp);
        OF_ONE(EXP2, exp2);
        OF_ONE(EXPM1, expm1);
        OF_ONE(LOG, log);
        OF_ONE(LOG2, log2);
        OF_ONE(LOG10, log10);
        OF_ONE(LOG1P, log1p);
        OF_ONE(CBRT, cbrt);
        OF_TWO(ARCTAN2, atan2);
        OF_TWO(HYPOT, hypot);
        OF_TWO(FMOD, fmod);
        OF_TWO(COPYSIGN, copysign);
        OF_TWO(FLOOR_DIVIDE, floor_divide);
    case POWER:
        operation_raise(first, second, count, to);
        break;
    case POWER_F:
        operation_raise32(first, second, count, to);
        break;
    case REMAINDER:
        operation_remain(first, second, count, to);
        break;
    case REMAINDER_Q:
        EACH(int64_t, remainder_of_whole(x[j], y[j]));
    default:
        EACH(int64_t, floor_divide_whole(x[j], y[j]));
    }
}

/* Compilers call a function of the C library that makes both, with the same results as those of one. */
void operation_turn(const double *angles, size_t count, double *sines, double *cosines) {
    for (size_t j = 0; j < count; j++) {
        const double angle = angles[j];
        sines[j] = sin(angle);
        cosines[j] = cos(angle);
    }
}
