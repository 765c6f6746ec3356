/* The floating-point environment: rounding mode, treatment of denormal numbers, traps.
 *
 * An FMU that changes the environment would alter the last bits of whatever its thread computes
 * next. So the pool restores it before the next instance runs. Reading the control register
 * takes a tenth of a small FMU's step, because the processor first finishes all pending
 * arithmetic. After a step the pool therefore only checks that sums are rounded as before. Sums
 * cannot reveal traps or the control word of the x87. Those are restored at the end of each
 * chunk of work. */

#ifndef FMUGYM_FLOATS_H
#define FMUGYM_FLOATS_H

#include <stdbool.h>
#include <stdint.h>

#if (defined __x86_64__ || defined _M_X64 || (defined __i386__ && defined __SSE2__)) &&           \
    !defined FMUGYM_PORTABLE_FLOATS
#define FMUGYM_FLOATS_X86
#include <emmintrin.h>
#elif defined __aarch64__ && defined __GNUC__ && !defined FMUGYM_PORTABLE_FLOATS
#define FMUGYM_FLOATS_ARM
#else
#include <fenv.h>
#endif

#if defined FMUGYM_FLOATS_X86

typedef struct {
    uint32_t sums[4]; /* results of sums that each rounding mode rounds differently */
    uint32_t sse;
    uint16_t x87;
} Floats;

#define FLOATS_STICKY ((uint32_t)0x3f) /* exception flags, which are not modes */

/* Computes sums that reveal the modes. The first differs when rounding upwards, the second when
 * rounding downwards or towards zero, and the others when denormal numbers count as zero. */
static inline __m128i floats_sums(void) {
    __m128 a = _mm_set_ps(0x1p-140f, 0x1p-140f, 1.0f, 1.0f);
    __m128 b = _mm_set_ps(0x1p-140f, 0x1p-141f, 0x1.8p-24f, 0x1p-26f);
#if defined __GNUC__
    __asm__ volatile("addps %1, %0" : "+x"(a) : "x"(b)); /* neither precomputed nor moved */
#else
    volatile __m128 first = a;
    a = _mm_add_ps(first, b);
#endif
    return _mm_castps_si128(a);
}

static inline uint16_t floats_x87(void) {
    uint16_t control = 0;
#if defined __GNUC__
    __asm__ volatile("fnstcw %0" : "=m"(control));
#endif
    return control;
}

static inline Floats floats_now(void) {
    Floats now = {.sse = _mm_getcsr() & ~FLOATS_STICKY, .x87 = floats_x87()};

    _mm_storeu_si128((__m128i *)now.sums, floats_sums());
    return now;
}

static inline bool floats_seem_same(const Floats *before) {
    const __m128i sums = _mm_loadu_si128((const __m128i *)before->sums);
    const __m128i same = _mm_cmpeq_epi32(floats_sums(), sums);
    return _mm_movemask_epi8(same) == 0xffff;
}

static inline void floats_restore(const Floats *before) {
    if ((_mm_getcsr() & ~FLOATS_STICKY) != before->sse) {
        _mm_setcsr(before->sse);
    }
#if defined __GNUC__
    if (floats_x87() != before->x87) {
        __asm__ volatile("fldcw %0" : : "m"(before->x87));
    }
#endif
}

#elif defined FMUGYM_FLOATS_ARM

typedef struct {
    uint64_t control;
} Floats;

static inline Floats floats_now(void) {
    Floats now;
    __asm__ volatile("mrs %0, fpcr" : "=r"(now.control));
    return now;
}

static inline bool floats_seem_same(const Floats *before) {
    return floats_now().control == before->control;
}

static inline void floats_restore(const Floats *before) {
    if (!floats_seem_same(before)) {
        __asm__ volatile("msr fpcr, %0" : : "r"(before->control));
    }
}

#else

typedef struct {
    fenv_t environment;
    int rounding;
} Floats;

static inline Floats floats_now(void) {
    Floats now;
    fegetenv(&now.environment);
    now.rounding = fegetround();
    return now;
}

/* Standard C can compare only the rounding mode without reading the whole environment. */
static inline bool floats_seem_same(const Floats *before) {
    return fegetround() == before->rounding;
}

static inline void floats_restore(const Floats *before) {
    fesetenv(&before->environment);
}

#endif

static inline void floats_restore_if_seen(const Floats *before) {
    if (!floats_seem_same(before)) {
        floats_restore(before);
    }
}

#endif
