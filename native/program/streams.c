/* PCG64 is the generator PCG XSL RR 128/64 of M. E. O'Neill, "PCG: A Family of Simple Fast
 * Space-Efficient Statistically Good Algorithms for Random Number Generation" (2014). */

#include "program/streams.h"

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
