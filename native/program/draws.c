/* Draws from distributions, with the same values as numpy's. */

#include "program/draws.h"

#include <math.h>

#define NAME(kind, name, numbers) name,
const char *const kind_names[NUMBER_OF_KINDS] = {DISTRIBUTIONS(NAME)};
#undef NAME

#define FEWEST(kind, name, numbers) numbers,
static const int64_t fewest_numbers[NUMBER_OF_KINDS] = {DISTRIBUTIONS(FEWEST)};
#undef FEWEST

static bool has_enough_numbers(const Draw *draw) {
    const int64_t fewest = fewest_numbers[draw->kind];

    switch (draw->kind) {
    case KIND_CHOICE:
    case KIND_SAME_ROW:
        return draw->count >= fewest && draw->count < UINT32_MAX;
    case KIND_WEIGHTED:
        return draw->count >= fewest && draw->count % 2 == 0;
    default:
        return draw->count == fewest;
    }
}

/* With a mean outside of the limits, drawing again might never end. */
static bool is_normal(const Draws *draws, const double *numbers) {
    return draws->standard_normal != NULL && isfinite(numbers[0]) && isfinite(numbers[1]) &&
           numbers[2] <= numbers[0] && numbers[0] <= numbers[3];
}

static bool is_sound(const Draws *draws, const Draw *draw, int64_t end) {
    return draw->kind >= 0 && draw->kind < NUMBER_OF_KINDS && has_enough_numbers(draw) &&
           draw->first >= 0 && draw->count <= end && draw->first <= end - draw->count &&
           draw->row >= -1 && (draw->kind != KIND_LOG_UNIFORM || draws->exponential != NULL) &&
           (draw->kind != KIND_NORMAL || is_normal(draws, draws->numbers + draw->first));
}

/* Only a choice of as many values, or what follows one, tells the place of a value. */
static bool has_place(const Draws *draws, size_t i) {
    const Draw *draw = &draws->draws[i];

    return draw->kind != KIND_SAME_ROW ||
           (i > 0 && draw[-1].count == draw->count &&
            (draw[-1].kind == KIND_CHOICE || draw[-1].kind == KIND_SAME_ROW));
}

bool draws_are_sound(const Draws *draws, size_t number_of_numbers) {
    for (size_t i = 0; i < draws->count; i++) {
        if (!is_sound(draws, &draws->draws[i], (int64_t)number_of_numbers) ||
            !has_place(draws, i)) {
            return false;
        }
    }
    return true;
}

bool draws_fit(const Draws *draws, size_t rows) {
    for (size_t i = 0; i < draws->count; i++) {
        if (draws->draws[i].row >= (int64_t)rows) {
            return false;
        }
    }
    return true;
}

/* The functions of a bit generator. */

static uint64_t next_64(void *stream) {
    return stream_next_64(stream);
}

static uint32_t next_32(void *stream) {
    return stream_next_32(stream);
}

static double next_double(void *stream) {
    return stream_next_double(stream);
}

BitGenerator bits_of(Stream *stream) {
    return (BitGenerator){stream, next_64, next_32, next_double, next_64};
}

static double uniform(BitGenerator *bits, const double *numbers) {
    const double scaled = numbers[1] * bits->next_double(bits->state);
    return numbers[0] + scaled;
}

static double normal(const Draws *draws, BitGenerator *bits, const double *numbers) {
    for (;;) {
        const double scaled = numbers[1] * draws->standard_normal(bits);
        const double value = numbers[0] + scaled;
        if (numbers[2] <= value && value <= numbers[3] && isfinite(value)) {
            return value;
        }
    }
}

/* An index below count, by the method of D. Lemire, "Fast Random Integer Generation in an
 * Interval" (2019). A single value needs no number. */
static size_t bounded(BitGenerator *bits, uint32_t count) {
    if (count == 1) {
        return 0;
    }
    const uint32_t threshold = (UINT32_MAX - (count - 1)) % count;
    uint64_t scaled = (uint64_t)bits->next_uint32(bits->state) * count;

    while ((uint32_t)scaled < threshold) {
        scaled = (uint64_t)bits->next_uint32(bits->state) * count;
    }
    return (size_t)(scaled >> 32);
}

/* The first value whose cumulated probability is above a uniform number. */
static double weighted(BitGenerator *bits, const double *cumulated, size_t count) {
    const double number = bits->next_double(bits->state);
    size_t low = 0, high = count - 1;

    while (low < high) {
        const size_t middle = (low + high) / 2;
        if (cumulated[middle] > number) {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    return cumulated[count + low];
}

/* The place of a choice stays for the draws that take the same row. */
static double take(const Draws *draws, const Draw *draw, BitGenerator *bits, size_t *place) {
    const double *numbers = draws->numbers + draw->first;

    switch (draw->kind) {
    case KIND_UNIFORM:
        return uniform(bits, numbers);
    case KIND_LOG_UNIFORM:
        return draws->exponential(uniform(bits, numbers));
    case KIND_NORMAL:
        return normal(draws, bits, numbers);
    case KIND_CHOICE:
        *place = bounded(bits, (uint32_t)draw->count);
        return numbers[*place];
    case KIND_SAME_ROW:
        return numbers[*place];
    default:
        return weighted(bits, numbers, (size_t)draw->count / 2);
    }
}

void draws_take(const Draws *draws, BitGenerator *bits, double *values, size_t stride) {
    size_t place = 0;

    for (size_t i = 0; i < draws->count; i++) {
        values[i * stride] = take(draws, &draws->draws[i], bits, &place);
    }
}

void draws_start(const Draws *draws, const double *values, double *start_values, size_t stride) {
    for (size_t i = 0; i < draws->count; i++) {
        if (draws->draws[i].row >= 0) {
            start_values[(size_t)draws->draws[i].row * stride] = values[i * stride];
        }
    }
}
