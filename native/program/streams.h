/* Random streams with the numbers of numpy's generator PCG64, which also seeds them. */

#ifndef FMUGYM_STREAMS_H
#define FMUGYM_STREAMS_H

#include <stddef.h>
#include <stdint.h>

/* The numbers of PCG64.state, in this order. */
typedef struct {
    uint64_t state_high, state_low;
    uint64_t increment_high, increment_low; /* makes the stream differ from other streams */
    uint64_t has_half;                      /* whether the last 32-bit draw has left a half */
    uint64_t half;
} Stream;

enum { STREAM_NUMBERS = sizeof(Stream) / sizeof(uint64_t) };

uint64_t stream_next_64(Stream *stream);
uint32_t stream_next_32(Stream *stream);
/* From [0, 1). */
double stream_next_double(Stream *stream);

#endif
