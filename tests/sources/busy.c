/* An FMU of FMI 2.0 for tests of speed and isolation; it exports no more than it must.

   Reals: 0 "work" (input, us of processor time per step), 1 "steps", 2 "total" (steps of all
   instances where SHARED is defined, else the same as steps), 3 "restore_work" (parameter, us per
   restored state), 4 "drift" (parameter, added to "offset" by restoring a state), 5 "offset".
   Where CRASH_IN_HELPER is defined, a step on any other thread than the main one crashes. */

#if defined CRASH_IN_HELPER
#define _GNU_SOURCE
#include <sys/syscall.h>
#include <unistd.h>
#endif

#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { WORK, STEPS, TOTAL, RESTORE_WORK, DRIFT, OFFSET, COUNT };

typedef struct {
    double values[COUNT];
} Busy;

#if defined SHARED
static double total;
#endif

static void work(double us) {
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    const double end = 1e6 * (double)now.tv_sec + 1e-3 * (double)now.tv_nsec + us;
    while (us > 0 && 1e6 * (double)now.tv_sec + 1e-3 * (double)now.tv_nsec < end) {
        clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    }
}

void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                      const void *callbacks, int visible, int logging) {
    return strcmp(token, "{busy}") == 0 ? calloc(1, sizeof(Busy)) : NULL;
}

void fmi2FreeInstance(Busy *me) {
    free(me);
}

int fmi2SetupExperiment(Busy *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    return 0;
}

int fmi2EnterInitializationMode(Busy *me) {
    return 0;
}

int fmi2ExitInitializationMode(Busy *me) {
    return 0;
}

int fmi2Reset(Busy *me) {
    memset(me, 0, sizeof *me);
    return 0;
}

int fmi2DoStep(Busy *me, double time, double step_size, int no_set_state) {
#if defined CRASH_IN_HELPER
    if (syscall(SYS_gettid) != getpid()) {
        volatile int *volatile nowhere = NULL;
        *nowhere = 1;
    }
#endif
    work(me->values[WORK]);
    me->values[STEPS]++;
#if defined SHARED
    me->values[TOTAL] = ++total;
#else
    me->values[TOTAL] = me->values[STEPS];
#endif
    return 0;
}

int fmi2GetReal(Busy *me, const unsigned *vr, size_t count, double *values) {
    for (size_t i = 0; i < count; i++) {
        values[i] = me->values[vr[i]];
    }
    return 0;
}

int fmi2SetReal(Busy *me, const unsigned *vr, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        me->values[vr[i]] = values[i];
    }
    return 0;
}

int fmi2GetFMUstate(Busy *me, void **state) {
    *state = malloc(sizeof *me);
    memcpy(*state, me, sizeof *me);
    return 0;
}

int fmi2SetFMUstate(Busy *me, void *state) {
    memcpy(me, state, sizeof *me);
    me->values[OFFSET] += me->values[DRIFT];
    work(me->values[RESTORE_WORK]);
    return 0;
}

int fmi2FreeFMUstate(Busy *me, void **state) {
    free(*state);
    *state = NULL;
    return 0;
}
