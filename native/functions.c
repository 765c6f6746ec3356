#include "operations.h"

#include <math.h>

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

/* The remainder of numpy has the sign of the divisor. */
static double remainder_of(double x, double y) {
    const double rest = fmod(x, y);

    if (rest == 0.0) {
        return copysign(rest, y);
    }
    return (rest < 0.0) != (y < 0.0) ? rest + y : rest;
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
        OF_TWO(POWER, pow);
        OF_TWO(FMOD, fmod);
        OF_TWO(COPYSIGN, copysign);
        OF_TWO(REMAINDER, remainder_of);
        OF_TWO(FLOOR_DIVIDE, floor_divide);
    case POWER_F:
        EACH(float, powf(x[j], y[j]));
    case REMAINDER_Q:
        EACH(int64_t, remainder_of_whole(x[j], y[j]));
    default:
        EACH(int64_t, floor_divide_whole(x[j], y[j]));
    }
}
