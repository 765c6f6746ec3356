/* An FMU of FMI 2.0 for tests of first meetings: what it does is in its token.

   Reals: 0 "u" (input), 1 "y" (output). Lines go to standard output and to the FMI logger. */

#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "fmi2_stubs.h"

typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);

typedef struct {
    Logger logger;
} Callbacks;

enum { NUMBERS = 512, HARMLESS_STEPS = 15, HARMLESS_RESETS = 2 };

typedef struct {
    double values[2];
    char token[32];
    double *numbers; /* a block of memory of its own */
    double *beside;  /* most likely the next block, so that what is beyond the first one is ours */
    int steps, resets;
} Mortal;

static int instances;
static void *shared; /* memory of the first instance, which each one frees */

static void fall_asleep(void) {
    const struct timespec hour = {3600, 0};
    for (;;) {
        nanosleep(&hour, NULL);
    }
}

static void do_as_told(const char *token, const char *call) {
    char wanted[64];
    snprintf(wanted, sizeof wanted, "segfault in %s", call);
    if (strcmp(token, wanted) == 0) {
        raise(SIGSEGV);
    }
    snprintf(wanted, sizeof wanted, "hang in %s", call);
    if (strcmp(token, wanted) == 0) {
        fall_asleep();
    }
}

void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                      const Callbacks *callbacks, int visible, int logging) {
    instances++;
    if (strcmp(token, "licence") == 0) {
        callbacks->logger(NULL, name, 3, "licence", "no licence for %d seats", 5);
        printf("so much for the licence\n"); /* not flushed */
        abort();
    }
    if (strcmp(token, "refuse") == 0) {
        callbacks->logger(NULL, name, 3, "licence", "all %d seats are taken", 5);
        return NULL;
    }
    if (strcmp(token, "exit") == 0) {
        printf("good bye\n");
        exit(0);
    }
    if (strcmp(token, "noise") == 0) {
        for (int i = 0; i < 100000; i++) {
            printf("{\"complete\": false} %d\n", i);
        }
        fflush(stdout);
    }
    if (strcmp(token, "closes files") == 0) {
        for (int i = 0; i < 100; i++) {
            close(i);
        }
    }
    if (strcmp(token, "lonely") == 0 && instances > 1) {
        abort();
    }
    do_as_told(token, "instantiate");
    Mortal *me = calloc(1, sizeof *me);
    snprintf(me->token, sizeof me->token, "%s", token);
    me->numbers = calloc(NUMBERS, sizeof *me->numbers);
    me->beside = calloc(NUMBERS, sizeof *me->beside);
    shared = shared == NULL ? malloc(NUMBERS) : shared;
    return me;
}

void fmi2FreeInstance(Mortal *me) {
    do_as_told(me->token, "free");
    if (strcmp(me->token, "free what is shared") == 0) {
        free(shared);
    }
    free(me->numbers);
    free(me->beside);
    free(me);
}

int fmi2SetupExperiment(Mortal *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    return 0;
}

int fmi2EnterInitializationMode(Mortal *me) {
    return strcmp(me->token, "needy") == 0 ? 3 : 0;
}

int fmi2ExitInitializationMode(Mortal *me) {
    do_as_told(me->token, "initialization");
    return 0;
}

int fmi2DoStep(Mortal *me, double time, double step_size, int no_set_state) {
    do_as_told(me->token, "step");
    me->values[1] = me->values[0];
    me->steps++;
    if (me->steps > HARMLESS_STEPS) {
        do_as_told(me->token, "a later step");
    }
    if (strcmp(me->token, "overrun later") == 0 && me->steps > HARMLESS_STEPS) {
        memset(me->numbers + NUMBERS, 1, 64);
    }
    return 0;
}

int fmi2GetReal(Mortal *me, const unsigned *vr, size_t count, double *values) {
    for (size_t i = 0; i < count; i++) {
        values[i] = me->values[vr[i]];
    }
    return 0;
}

int fmi2SetReal(Mortal *me, const unsigned *vr, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        me->values[vr[i]] = values[i];
    }
    return 0;
}

int fmi2Terminate(Mortal *me) {
    return 0;
}

int fmi2Reset(Mortal *me) {
    if (++me->resets > HARMLESS_RESETS) {
        do_as_told(me->token, "a later reset");
    }
    me->values[0] = me->values[1] = 0.0;
    return 0;
}

STUB(GetFMUstate)
STUB(SetFMUstate)
STUB(FreeFMUstate)
