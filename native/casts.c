#include "operations.h"

#include "halves.h"
#include "platform.h"

typedef bool Flag;

#define CAST_LOOP(number, From, To)                                                                \
    case number: {                                                                                 \
        const From *restrict values = from;                                                        \
        To *restrict into = to;                                                                    \
        EACH_LANE(into[j] = (To)values[j]);                                                        \
        break;                                                                                     \
    }

#define CASTS_FROM(number, From)                                                                   \
    case number:                                                                                   \
        switch (to_type) {                                                                         \
            CAST_LOOP(0, From, double)                                                             \
            CAST_LOOP(1, From, float)                                                              \
            CAST_LOOP(2, From, int64_t)                                                            \
            CAST_LOOP(3, From, int32_t)                                                            \
            CAST_LOOP(4, From, int16_t)                                                            \
            CAST_LOOP(5, From, int8_t)                                                             \
            CAST_LOOP(6, From, uint64_t)                                                           \
            CAST_LOOP(7, From, uint32_t)                                                           \
            CAST_LOOP(8, From, uint16_t)                                                           \
            CAST_LOOP(9, From, uint8_t)                                                            \
            CAST_LOOP(10, From, Flag)                                                              \
        }                                                                                          \
        break;

WIDE static void cast_numbers(int from_type, int to_type, const void *from, size_t blocks,
                              void *to) {
    switch (from_type) {
        CASTS_FROM(0, double)
        CASTS_FROM(1, float)
        CASTS_FROM(2, int64_t)
        CASTS_FROM(3, int32_t)
        CASTS_FROM(4, int16_t)
        CASTS_FROM(5, int8_t)
        CASTS_FROM(6, uint64_t)
        CASTS_FROM(7, uint32_t)
        CASTS_FROM(8, uint16_t)
        CASTS_FROM(9, uint8_t)
        CASTS_FROM(10, Flag)
    }
}

/* A half becomes a float first, as in numpy. */
static void cast_halves(const Half *from, int to_type, size_t blocks, void *to) {
    Register floats;

    EACH_LANE(floats.floats[j] = half_to_float(from[j]));
    cast_numbers(VALUE_FLOAT, to_type, floats.floats, blocks, to);
}

/* Integers become floats first, as in numpy. */
static void cast_to_halves(int from_type, const void *from, size_t blocks, Half *to) {
    const double *doubles = from;
    Register floats;

    if (from_type == VALUE_DOUBLE) {
        EACH_LANE(to[j] = half_of(doubles[j]));
        return;
    }
    cast_numbers(from_type, VALUE_FLOAT, from, blocks, floats.floats);
    EACH_LANE(to[j] = half_of(floats.floats[j]));
}

void operation_cast(uint16_t types, const void *from, size_t blocks, void *to) {
    const int from_type = types / VALUE_TYPES, to_type = types % VALUE_TYPES;

    if (from_type == VALUE_HALF) {
        cast_halves(from, to_type, blocks, to);
    } else if (to_type == VALUE_HALF) {
        cast_to_halves(from_type, from, blocks, to);
    } else {
        cast_numbers(from_type, to_type, from, blocks, to);
    }
}
