#include "halves.h"

#include <math.h>
#include <string.h>

float half_to_float(Half half) {
    const uint32_t sign = (uint32_t)(half & 0x8000) << 16;
    const uint32_t exponent = half >> 10 & 31, fraction = half & 1023;
    float value = (float)fraction * 0x1p-24f; /* if it is subnormal */
    uint32_t bits = (exponent + 112) << 23 | fraction << 13;

    if (exponent == 31) {
        bits |= 0x7f800000;
    }
    if (exponent == 0) {
        memcpy(&bits, &value, sizeof bits);
    }
    bits |= sign;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Numbers below the smallest normal half are multiples of the smallest half. */
static Half magnitude_of(double value) {
    uint64_t bits;

    if (value < 0x1p-14) {
        return (Half)nearbyint(value * 0x1p24);
    }
    if (!(value < 65520.0)) {
        return isnan(value) ? 0x7e00 : 0x7c00;
    }
    memcpy(&bits, &value, sizeof bits);
    bits += (UINT64_C(1) << 41) - 1 + ((bits >> 42) & 1); /* 42 bits fall away */
    return (Half)((bits >> 42) - ((uint64_t)(1023 - 15) << 10));
}

Half half_of(double value) {
    const Half sign = signbit(value) ? 0x8000 : 0;
    return sign | magnitude_of(fabs(value));
}
