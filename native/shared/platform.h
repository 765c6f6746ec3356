/* What differs between operating systems and compilers: atomics, locks, threads, the clock. */

#ifndef FMUGYM_PLATFORM_H
#define FMUGYM_PLATFORM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#if defined _WIN32
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
#else
#include <pthread.h>
#include <time.h>
#include <unistd.h>
#endif

#if defined _MSC_VER || defined FMUGYM_INTERLOCKED
#include <windows.h>
#else
#define FMUGYM_STDATOMIC
#include <stdatomic.h>
#endif

static inline int64_t number_of_process(void) {
#if defined _WIN32
    return (int64_t)GetCurrentProcessId();
#else
    return (int64_t)getpid();
#endif
}

/* In bytes. Data that several threads write gets its own cache lines. */
enum { CACHE_LINE = 64 };

/* For loops that run faster with wider vector instructions, where the processor has them. The
 * results are the same because no operations are fused. The choice is made while the library is
 * loaded, when the thread sanitizer cannot work yet. */
#if defined __x86_64__ && defined __linux__ && defined __GLIBC__ && !defined __SANITIZE_THREAD__
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif

/* For functions that become much faster when the compiler knows their arguments. */
#if defined _MSC_VER
#define ALWAYS_INLINE __forceinline
#else
#define ALWAYS_INLINE inline __attribute__((always_inline))
#endif

/* For what happens so rarely that it must not lengthen the function which calls it. */
#if defined _MSC_VER
#define NEVER_INLINE __declspec(noinline)
#else
#define NEVER_INLINE __attribute__((noinline))
#endif

/* Atomics. All are sequentially consistent. That costs little, because each is used at most once
 * per chunk of work. */

#if defined FMUGYM_STDATOMIC

typedef _Atomic uint64_t Atomic;

static inline uint64_t atomic_get(const Atomic *a) {
    return atomic_load(a);
}
static inline void atomic_set(Atomic *a, uint64_t value) {
    atomic_store(a, value);
}
static inline uint64_t atomic_add(Atomic *a, uint64_t value) {
    return atomic_fetch_add(a, value);
}
static inline uint64_t atomic_or_bits(Atomic *a, uint64_t bits) {
    return atomic_fetch_or(a, bits);
}
static inline uint64_t atomic_and_bits(Atomic *a, uint64_t bits) {
    return atomic_fetch_and(a, bits);
}
/* Replaces the value if it equals the expected one, and returns whether it did. Otherwise stores
 * the present value in expected. */
static inline bool atomic_replace(Atomic *a, uint64_t *expected, uint64_t value) {
    return atomic_compare_exchange_strong(a, expected, value);
}

#else

typedef volatile LONG64 Atomic;

static inline uint64_t atomic_get(const Atomic *a) {
    return (uint64_t)InterlockedCompareExchange64((Atomic *)a, 0, 0);
}
static inline void atomic_set(Atomic *a, uint64_t value) {
    InterlockedExchange64(a, (LONG64)value);
}
static inline uint64_t atomic_add(Atomic *a, uint64_t value) {
    return (uint64_t)InterlockedExchangeAdd64(a, (LONG64)value);
}
static inline uint64_t atomic_or_bits(Atomic *a, uint64_t bits) {
    return (uint64_t)InterlockedOr64(a, (LONG64)bits);
}
static inline uint64_t atomic_and_bits(Atomic *a, uint64_t bits) {
    return (uint64_t)InterlockedAnd64(a, (LONG64)bits);
}
static inline bool atomic_replace(Atomic *a, uint64_t *expected, uint64_t value) {
    const LONG64 seen = InterlockedCompareExchange64(a, (LONG64)value, (LONG64)*expected);
    const bool replaced = seen == (LONG64)*expected;
    *expected = (uint64_t)seen;
    return replaced;
}

#endif

/* This thread-local storage model suits small data in a library that is loaded late. */
#if defined _MSC_VER
#define THREAD_LOCAL __declspec(thread)
#elif defined __linux__
#define THREAD_LOCAL _Thread_local __attribute__((tls_model("initial-exec")))
#else
#define THREAD_LOCAL _Thread_local
#endif

/* Locks and conditions */

#if defined _WIN32

typedef SRWLOCK Mutex;
typedef CONDITION_VARIABLE Condition;
#define MUTEX_INITIALIZER SRWLOCK_INIT
#define CONDITION_INITIALIZER CONDITION_VARIABLE_INIT

static inline void mutex_lock(Mutex *m) {
    AcquireSRWLockExclusive(m);
}
static inline bool mutex_try_lock(Mutex *m) {
    return TryAcquireSRWLockExclusive(m) != 0;
}
static inline void mutex_unlock(Mutex *m) {
    ReleaseSRWLockExclusive(m);
}
static inline void mutex_destroy(Mutex *m) {
    (void)m;
}
static inline void condition_wait(Condition *c, Mutex *m) {
    SleepConditionVariableSRW(c, m, INFINITE, 0);
}
/* Returns false after so many ms. */
static inline bool condition_wait_for(Condition *c, Mutex *m, int milliseconds) {
    return SleepConditionVariableSRW(c, m, (DWORD)milliseconds, 0) != 0;
}
static inline void condition_wake_one(Condition *c) {
    WakeConditionVariable(c);
}
static inline void condition_wake_all(Condition *c) {
    WakeAllConditionVariable(c);
}

#else

typedef pthread_mutex_t Mutex;
typedef pthread_cond_t Condition;
#define MUTEX_INITIALIZER PTHREAD_MUTEX_INITIALIZER
#define CONDITION_INITIALIZER PTHREAD_COND_INITIALIZER

static inline void mutex_lock(Mutex *m) {
    pthread_mutex_lock(m);
}
static inline bool mutex_try_lock(Mutex *m) {
    return pthread_mutex_trylock(m) == 0;
}
static inline void mutex_unlock(Mutex *m) {
    pthread_mutex_unlock(m);
}
static inline void mutex_destroy(Mutex *m) {
    pthread_mutex_destroy(m);
}
static inline void condition_wait(Condition *c, Mutex *m) {
    pthread_cond_wait(c, m);
}
/* Returns false after so many ms. */
static inline bool condition_wait_for(Condition *c, Mutex *m, int milliseconds) {
    struct timespec end;

    clock_gettime(CLOCK_REALTIME, &end);
    end.tv_nsec += (long)(milliseconds % 1000) * 1000000;
    end.tv_sec += milliseconds / 1000 + end.tv_nsec / 1000000000;
    end.tv_nsec %= 1000000000;
    return pthread_cond_timedwait(c, m, &end) == 0;
}
static inline void condition_wake_one(Condition *c) {
    pthread_cond_signal(c);
}
static inline void condition_wake_all(Condition *c) {
    pthread_cond_broadcast(c);
}

#endif

static inline void mutex_reset(Mutex *m) {
    const Mutex fresh = MUTEX_INITIALIZER;
    *m = fresh;
}
static inline void condition_reset(Condition *c) {
    const Condition fresh = CONDITION_INITIALIZER;
    *c = fresh;
}

/* A monotonic clock, in nanoseconds. */

static inline uint64_t clock_now(void) {
#if defined _WIN32
    LARGE_INTEGER count, frequency;
    QueryPerformanceCounter(&count);
    QueryPerformanceFrequency(&frequency);
    return (uint64_t)((double)count.QuadPart * (1e9 / (double)frequency.QuadPart));
#else
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
#endif
}

/* Prefetches memory that will be read soon and is probably not in the cache. */
static inline void prefetch(const void *place) {
#if defined __GNUC__
    __builtin_prefetch(place);
#else
    (void)place;
#endif
}

/* Tells the processor that this thread waits for another in a loop. */
static inline void spin_pause(void) {
#if defined _MSC_VER
    YieldProcessor();
#elif defined __x86_64__ || defined __i386__
    __builtin_ia32_pause();
#elif defined __aarch64__
    __asm__ volatile("yield");
#endif
}

#endif
