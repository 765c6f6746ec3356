#include "operations.h"

#include <math.h>

#include "platform.h"

#define EACH(Type, Result, expression)                                                             \
    {                                                                                              \
        const Type *restrict x = first, *restrict y = second;                                      \
        Result *restrict r = to;                                                                   \
        (void)y;                                                                                   \
        EACH_LANE(r[j] = (expression));                                                            \
    }                                                                                              \
    break

#define CHOOSE(Type)                                                                               \
    {                                                                                              \
        const uint8_t *restrict chosen = first;                                                    \
        const Type *restrict x = second, *restrict y = third;                                      \
        Type *restrict r = to;                                                                     \
        EACH_LANE(r[j] = chosen[j] ? x[j] : y[j]);                                                 \
    }                                                                                              \
    break

/* Integers wrap around, as those of numpy do. */
#define WRAPPED(expression) (int64_t)(expression)

WIDE void operation_compute(uint16_t operation, const void *first, const void *second,
                            const void *third, size_t blocks, void *to) {
    switch (operation) {
    case ADD_D:
        EACH(double, double, x[j] + y[j]);
    case SUBTRACT_D:
        EACH(double, double, x[j] - y[j]);
    case MULTIPLY_D:
        EACH(double, double, x[j] * y[j]);
    case DIVIDE_D:
        EACH(double, double, x[j] / y[j]);
    case SQUARE_D:
        EACH(double, double, x[j] * x[j]);
    case NEGATIVE_D:
        EACH(double, double, -x[j]);
    case ABSOLUTE_D:
        EACH(double, double, fabs(x[j]));
    case SQRT_D:
        EACH(double, double, sqrt(x[j]));
    case MINIMUM_D:
        EACH(double, double, x[j] < y[j] || isnan(x[j]) ? x[j] : y[j]);
    case MAXIMUM_D:
        EACH(double, double, x[j] > y[j] || isnan(x[j]) ? x[j] : y[j]);
    case LESS_D:
        EACH(double, uint8_t, x[j] < y[j]);
    case LESS_EQUAL_D:
        EACH(double, uint8_t, x[j] <= y[j]);
    case GREATER_D:
        EACH(double, uint8_t, x[j] > y[j]);
    case GREATER_EQUAL_D:
        EACH(double, uint8_t, x[j] >= y[j]);
    case EQUAL_D:
        EACH(double, uint8_t, x[j] == y[j]);
    case NOT_EQUAL_D:
        EACH(double, uint8_t, x[j] != y[j]);
    case ADD_F:
        EACH(float, float, x[j] + y[j]);
    case SUBTRACT_F:
        EACH(float, float, x[j] - y[j]);
    case MULTIPLY_F:
        EACH(float, float, x[j] * y[j]);
    case DIVIDE_F:
        EACH(float, float, x[j] / y[j]);
    case SQUARE_F:
        EACH(float, float, x[j] * x[j]);
    case NEGATIVE_F:
        EACH(float, float, -x[j]);
    case ABSOLUTE_F:
        EACH(float, float, fabsf(x[j]));
    case SQRT_F:
        EACH(float, float, sqrtf(x[j]));
    case MINIMUM_F:
        EACH(float, float, x[j] < y[j] || isnan(x[j]) ? x[j] : y[j]);
    case MAXIMUM_F:
        EACH(float, float, x[j] > y[j] || isnan(x[j]) ? x[j] : y[j]);
    case ADD_Q:
        EACH(uint64_t, int64_t, WRAPPED(x[j] + y[j]));
    case SUBTRACT_Q:
        EACH(uint64_t, int64_t, WRAPPED(x[j] - y[j]));
    case MULTIPLY_Q:
        EACH(uint64_t, int64_t, WRAPPED(x[j] * y[j]));
    case NEGATIVE_Q:
        EACH(uint64_t, int64_t, WRAPPED(0 - x[j]));
    case LESS_Q:
        EACH(int64_t, uint8_t, x[j] < y[j]);
    case LESS_EQUAL_Q:
        EACH(int64_t, uint8_t, x[j] <= y[j]);
    case GREATER_Q:
        EACH(int64_t, uint8_t, x[j] > y[j]);
    case GREATER_EQUAL_Q:
        EACH(int64_t, uint8_t, x[j] >= y[j]);
    case EQUAL_Q:
        EACH(int64_t, uint8_t, x[j] == y[j]);
    case NOT_EQUAL_Q:
        EACH(int64_t, uint8_t, x[j] != y[j]);
    case AND:
        EACH(uint8_t, uint8_t, x[j] & y[j]);
    case OR:
        EACH(uint8_t, uint8_t, x[j] | y[j]);
    case XOR:
        EACH(uint8_t, uint8_t, x[j] ^ y[j]);
    case NOT:
        EACH(uint8_t, uint8_t, x[j] ^ 1);
    case WHERE_8:
        CHOOSE(uint64_t);
    case WHERE_4:
        CHOOSE(uint32_t);
    case WHERE_2:
        CHOOSE(uint16_t);
    default:
        CHOOSE(uint8_t);
    }
}

/* The power of scalars, which is that of the C library in Python and in numpy. */
void operation_power(uint16_t operation, size_t count, const void *bases, const void *exponents,
                     Register *to) {
    if (operation == POWER_D) {
        const double *base = bases, *exponent = exponents;
        for (size_t j = 0; j < count; j++) {
            to->doubles[j] = pow(base[j], exponent[j]);
        }
        return;
    }
    const float *base = bases, *exponent = exponents;
    for (size_t j = 0; j < count; j++) {
        to->floats[j] = powf(base[j], exponent[j]);
    }
}
