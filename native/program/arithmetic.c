/* Arithmetic instructions of programs: sums, products, comparisons and logic. */

#include "program/operations.h"

#include <math.h>

#include "shared/platform.h"

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

/* Integers wrap around, as those of numpy do, if they are added without their sign. */
#define ARITHMETIC_OF(T, Type, Added)                                                              \
    case ADD_##T:                                                                                  \
        EACH(Added, Type, (Type)(x[j] + y[j]));                                                    \
    case SUBTRACT_##T:                                                                             \
        EACH(Added, Type, (Type)(x[j] - y[j]));                                                    \
    case MULTIPLY_##T:                                                                             \
        EACH(Added, Type, (Type)(x[j] * y[j]));                                                    \
    case MINIMUM_##T:                                                                              \
        EACH(Type, Type, x[j] < y[j] || x[j] != x[j] ? x[j] : y[j]);                               \
    case MAXIMUM_##T:                                                                              \
        EACH(Type, Type, x[j] > y[j] || x[j] != x[j] ? x[j] : y[j]);                               \
    case LESS_##T:                                                                                 \
        EACH(Type, uint8_t, x[j] < y[j]);                                                          \
    case LESS_EQUAL_##T:                                                                           \
        EACH(Type, uint8_t, x[j] <= y[j]);                                                         \
    case GREATER_##T:                                                                              \
        EACH(Type, uint8_t, x[j] > y[j]);                                                          \
    case GREATER_EQUAL_##T:                                                                        \
        EACH(Type, uint8_t, x[j] >= y[j]);                                                         \
    case EQUAL_##T:                                                                                \
        EACH(Type, uint8_t, x[j] == y[j]);                                                         \
    case NOT_EQUAL_##T:                                                                            \
        EACH(Type, uint8_t, x[j] != y[j])

WIDE void operation_compute(uint16_t operation, const void *first, const void *second,
                            const void *third, size_t blocks, void *to) {
    switch (operation) {
        ARITHMETIC_OF(D, double, double);
        ARITHMETIC_OF(F, float, float);
        ARITHMETIC_OF(Q, int64_t, uint64_t);
    case NEGATIVE_D:
        EACH(double, double, -x[j]);
    case NEGATIVE_F:
        EACH(float, float, -x[j]);
    case NEGATIVE_Q:
        EACH(uint64_t, int64_t, (int64_t)(0 - x[j]));
    case DIVIDE_D:
        EACH(double, double, x[j] / y[j]);
    case DIVIDE_F:
        EACH(float, float, x[j] / y[j]);
    case ABSOLUTE_D:
        EACH(double, double, fabs(x[j]));
    case ABSOLUTE_F:
        EACH(float, float, fabsf(x[j]));
    case SQRT_D:
        EACH(double, double, sqrt(x[j]));
    case SQRT_F:
        EACH(float, float, sqrtf(x[j]));
    case FLOOR_D:
        EACH(double, double, floor(x[j]));
    case CEIL_D:
        EACH(double, double, ceil(x[j]));
    case TRUNC_D:
        EACH(double, double, trunc(x[j]));
    case RINT_D:
        EACH(double, double, rint(x[j]));
    case BITWISE_AND_Q:
        EACH(int64_t, int64_t, x[j] & y[j]);
    case BITWISE_XOR_Q:
        EACH(int64_t, int64_t, x[j] ^ y[j]);
    case RIGHT_SHIFT_Q:
        EACH(int64_t, int64_t, x[j] >> ((uint64_t)y[j] < 64 ? y[j] : 63));
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
    default:
        CHOOSE(uint8_t);
    }
}
