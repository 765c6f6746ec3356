/* An FMU of FMI 2.0 whose steps take a given processor time and do nothing.
 *
 * A step takes "mean" us. With "sigma" > 0, its time has a lognormal distribution with this mean:
 *
 *     mean * exp(sigma * z - sigma^2 / 2)
 *
 * where z is standard normal, from a hash of "seed" and the number of the step. With the probability
 * "rare", a step takes "rare_time" us instead. "busy" is the sum in us of the times that steps were to
 * take: measured ones would differ from episode to episode, so that the FMU would get processes of
 * its own. A step looks at the wall clock, since reading a clock of processor time costs up to a
 * microsecond. If more than LAPSE us have passed since the last reading, another process had the
 * processor, and this time does not count. The value references are those of the enumeration. */

#define _GNU_SOURCE
#define LAPSE 100.0

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { INPUT, BUSY, MEAN, SIGMA, SEED, RARE, RARE_TIME, COUNT };

typedef struct {
    double values[COUNT];
    uint64_t steps;
} Busy;

/* The finalizer of SplitMix64 (Steele, Lea and Flood, 2014). */
static uint64_t mix(uint64_t x) {
    x += 0x9e3779b97f4a7c15u;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}

/* Uniform in (0, 1). */
static double uniform(uint64_t x) {
    return ((double)(mix(x) >> 11) + 0.5) / 9007199254740992.0;
}

static uint64_t hash(const Busy *me) {
    return mix((uint64_t)(me->values[SEED] * 4294967296.0)) + 2 * me->steps;
}

/* Standard normal, by Box and Muller. */
static double normal(const Busy *me) {
    const uint64_t x = hash(me);
    return sqrt(-2.0 * log(uniform(x))) * cos(6.283185307179586 * uniform(x + 1));
}

static double now_us(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return 1e6 * (double)now.tv_sec + 1e-3 * (double)now.tv_nsec;
}

static void be_busy(double us) {
    double last = now_us(), taken = 0.0;

    while (taken < us) {
        const double now = now_us();
        taken += now - last < LAPSE ? now - last : 0.0;
        last = now;
    }
}

void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                      const void *callbacks, int visible, int logging) {
    (void)name, (void)type, (void)resources, (void)callbacks, (void)visible, (void)logging;
    return strcmp(token, "{busy}") == 0 ? calloc(1, sizeof(Busy)) : NULL;
}

void fmi2FreeInstance(Busy *me) {
    free(me);
}

int fmi2SetupExperiment(Busy *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    (void)me, (void)tolerance_defined, (void)tolerance, (void)start, (void)stop_defined, (void)stop;
    return 0;
}

int fmi2EnterInitializationMode(Busy *me) {
    (void)me;
    return 0;
}

int fmi2ExitInitializationMode(Busy *me) {
    (void)me;
    return 0;
}

int fmi2Reset(Busy *me) {
    memset(me, 0, sizeof *me);
    return 0;
}

int fmi2DoStep(Busy *me, double time, double step_size, int no_set_state) {
    const double sigma = me->values[SIGMA];
    double us = me->values[MEAN];

    (void)time, (void)step_size, (void)no_set_state;
    if (sigma > 0) {
        us *= exp(sigma * normal(me) - sigma * sigma / 2);
    }
    if (uniform(hash(me)) < me->values[RARE]) {
        us = me->values[RARE_TIME];
    }
    me->steps++;
    me->values[BUSY] += us;
    be_busy(us);
    return 0;
}

int fmi2GetReal(Busy *me, const unsigned *references, size_t count, double *values) {
    for (size_t i = 0; i < count; i++) {
        values[i] = me->values[references[i]];
    }
    return 0;
}

int fmi2SetReal(Busy *me, const unsigned *references, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        me->values[references[i]] = values[i];
    }
    return 0;
}
