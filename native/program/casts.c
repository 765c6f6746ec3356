/* Instructions of programs that convert between types. */

#include "program/operations.h"

#include "shared/platform.h"

#define CAST_LOOP(type, From, To)                                                                  \
    case type: {                                                                                   \
        const From *restrict values = from;                                                        \
        To *restrict into = to;                                                                    \
        EACH_LANE(into[j] = (To)values[j]);                                                        \
        break;                                                                                     \
    }

#define CASTS_FROM(type, From)                                                                     \
    case type:                                                                                     \
        switch (to_type) {                                                                         \
            CAST_LOOP(VALUE_DOUBLE, From, double)                                                  \
            CAST_LOOP(VALUE_FLOAT, From, float)                                                    \
            CAST_LOOP(VALUE_INTEGER, From, int64_t)                                                \
            CAST_LOOP(VALUE_FLAG, From, bool)                                                      \
            CAST_LOOP(VALUE_BYTE, From, int8_t)                                                    \
        }                                                                                          \
        break;

WIDE void operation_cast(uint16_t types, const void *from, size_t blocks, void *to) {
    const int from_type = types / VALUE_TYPES, to_type = types % VALUE_TYPES;

    switch (from_type) {
        CASTS_FROM(VALUE_DOUBLE, double)
        CASTS_FROM(VALUE_FLOAT, float)
        CASTS_FROM(VALUE_INTEGER, int64_t)
        CASTS_FROM(VALUE_FLAG, bool)
        CASTS_FROM(VALUE_BYTE, int8_t)
    }
}
