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
    case SIN:
        EACH(double, sin(x[j]));
    case COS:
        EACH(double, cos(x[j]));
    case TAN:
        EACH(double, tan(x[j]));
    case ARCSIN:
        EACH(double, asin(x[j]));
    case ARCCOS:
        EACH(double, acos(x[j]));
    case ARCTAN:
        EACH(double, atan(x[j]));
    case SINH:
        EACH(double, sinh(x[j]));
    case COSH:
        EACH(double, cosh(x[j]));
    case TANH:
        EACH(double, tanh(x[j]));
    case ARCSINH:
        EACH(double, asinh(x[j]));
    case ARCCOSH:
        EACH(double, acosh(x[j]));
    case ARCTANH:
        EACH(double, atanh(x[j]));
    case EXP:
        EACH(double, exp(x[j]));
    case EXP2:
        EACH(double, exp2(x[j]));
    case EXPM1:
        EACH(double, expm1(x[j]));
    case LOG:
        EACH(double, log(x[j]));
    case LOG2:
        EACH(double, log2(x[j]));
    case LOG10:
        EACH(double, log10(x[j]));
    case LOG1P:
        EACH(double, log1p(x[j]));
    case CBRT:
        EACH(double, cbrt(x[j]));
    case ARCTAN2:
        EACH(double, atan2(x[j], y[j]));
    case HYPOT:
        EACH(double, hypot(x[j], y[j]));
    case POWER:
        EACH(double, pow(x[j], y[j]));
    case POWER_F:
        EACH(float, powf(x[j], y[j]));
    case FMOD:
        EACH(double, fmod(x[j], y[j]));
    case COPYSIGN:
        EACH(double, copysign(x[j], y[j]));
    case REMAINDER:
        EACH(double, remainder_of(x[j], y[j]));
    case FLOOR_DIVIDE:
        EACH(double, floor_divide(x[j], y[j]));
    case REMAINDER_Q:
        EACH(int64_t, remainder_of_whole(x[j], y[j]));
    default:
        EACH(int64_t, floor_divide_whole(x[j], y[j]));
    }
}
