/* PCG64 is the generator PCG XSL RR 128/64 of M. E. O'Neill, "PCG: A Family of Simple Fast
 * Space-Efficient Statistically Good Algorithms for Random Number Generation" (2014). SeedSequence
 * is described in numpy's documentation; it follows M. E. O'Neill's "Developing a seed_seq
 * Alternative" (2015). */

#include "program/streams.h"

#include <string.h>

typedef struct {
    uint64_t high, low;
} Wide;

static const Wide MULTIPLIER = {0x2360ed051fc65da4u, 0x4385df649fccf645u};

#if defined __SIZEOF_INT128__

static Wide product(uint64_t a, uint64_t b) {
    __extension__ typedef unsigned __int128 Whole;
    const Whole whole = (Whole)a * b;
    return (Wide){(uint64_t)(whole >> 64), (uint64_t)whole};
}

#else

static Wide product(uint64_t a, uint64_t b) {
    const uint64_t half = UINT32_MAX, a_low = a & half, b_low = b & half;
    const uint64_t low = a_low * b_low;
    const uint64_t first = (a >> 32) * b_low + (low >> 32);
    const uint64_t second = a_low * (b >> 32) + (first & half);
    return (Wide){(a >> 32) * (b >> 32) + (first >> 32) + (second >> 32), a * b};
}

#endif

static Wide sum(Wide a, Wide b) {
    const uint64_t low = a.low + b.low;
    return (Wide){a.high + b.high + (low < a.low), low};
}

/* Seeding */

enum { POOL_WORDS = 4 };

static uint32_t stir(uint32_t value, uint32_t *constant, uint32_t multiplier) {
    value ^= *constant;
    *constant *= multiplier;
    value *= *constant;
    return value ^ value >> 16;
}

static uint32_t mix(uint32_t a, uint32_t b) {
    const uint32_t mixed = 0xca01f9ddu * a - 0x4973f715u * b;
    return mixed ^ mixed >> 16;
}

/* Spreads the entropy of all words over the pool. */
static void gather(uint32_t *pool, const uint32_t *words, size_t count) {
    const uint32_t multiplier = 0x931e8875u;
    uint32_t constant = 0x43b0d7e5u;

    for (size_t i = 0; i < POOL_WORDS; i++) {
        pool[i] = stir(i < count ? words[i] : 0, &constant, multiplier);
    }
    for (size_t from = 0; from < POOL_WORDS; from++) {
        for (size_t to = 0; to < POOL_WORDS; to++) {
            if (from != to) {
                pool[to] = mix(pool[to], stir(pool[from], &constant, multiplier));
            }
        }
    }
    for (size_t from = POOL_WORDS; from < count; from++) {
        for (size_t to = 0; to < POOL_WORDS; to++) {
            pool[to] = mix(pool[to], stir(words[from], &constant, multiplier));
        }
    }
}

/* Writes pairs of words, the lower word first. */
static void hand_out(const uint32_t *pool, uint64_t *numbers, size_t count) {
    const uint32_t multiplier = 0x58f38dedu;
    uint32_t constant = 0x8b51f9ddu;

    for (size_t i = 0; i < count; i++) {
        const uint64_t low = stir(pool[2 * i % POOL_WORDS], &constant, multiplier);
        const uint64_t high = stir(pool[(2 * i + 1) % POOL_WORDS], &constant, multiplier);
        numbers[i] = high << 32 | low;
    }
}

static size_t without_leading_zeros(const uint32_t *words, size_t count) {
    while (count > 0 && words[count - 1] == 0) {
        count--;
    }
    return count;
}

static void put_state(Stream *stream, Wide state) {
    stream->state_high = state.high;
    stream->state_low = state.low;
}

static Wide advance(Stream *stream) {
    const Wide increment = {stream->increment_high, stream->increment_low};
    Wide state = product(stream->state_low, MULTIPLIER.low);

    state.high += stream->state_high * MULTIPLIER.low + stream->state_low * MULTIPLIER.high;
    state = sum(state, increment);
    put_state(stream, state);
    return state;
}

void stream_seed(Stream *stream, const uint32_t *words, size_t count) {
    uint32_t pool[POOL_WORDS];
    uint64_t numbers[4];

    gather(pool, words, without_leading_zeros(words, count));
    hand_out(pool, numbers, 4);
    memset(stream, 0, sizeof *stream);
    stream->increment_high = numbers[2] << 1 | numbers[3] >> 63;
    stream->increment_low = numbers[3] << 1 | 1;
    put_state(stream, sum(advance(stream), (Wide){numbers[0], numbers[1]}));
    advance(stream);
}

/* Numbers */

uint64_t stream_next_64(Stream *stream) {
    const Wide state = advance(stream);
    const uint64_t folded = state.high ^ state.low;
    const unsigned turn = (unsigned)(state.high >> 58);

    return folded >> turn | folded << (-turn & 63);
}

uint32_t stream_next_32(Stream *stream) {
    if (stream->has_half != 0) {
        stream->has_half = 0;
        return (uint32_t)stream->half;
    }
    const uint64_t number = stream_next_64(stream);
    stream->has_half = 1;
    stream->half = number >> 32;
    return (uint32_t)number;
}

double stream_next_double(Stream *stream) {
    return (double)(stream_next_64(stream) >> 11) * (1.0 / 9007199254740992.0);
}
