/* An FMU of FMI 2.0 that does to its process what it is told, where it is told.

   y' = u. The parameter "fault" is what happens (see enum fault), "stage" where (see enum stage), and
   "at" the step for STEP. Parameters come too late for instantiation: there a token "{faulty-F}" asks
   for fault F. "lonely" counts instances in the process's environment, where a copy of the library
   finds them too. */

#define _GNU_SOURCE
#include <math.h>
#include <signal.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "fmi2_stubs.h"

#if defined _WIN32
#define setenv(name, value, overwrite) _putenv_s(name, value)
#define unsetenv(name) _putenv_s(name, "")
#endif

enum { U, Y, FAULT, STAGE, AT, COUNT };
enum fault { NONE, CRASH, ABORT, EXIT, HANG, CLOSE, PAUSE, LEAK };
enum stage { NOWHERE, STEP, RESET, TERMINATE, FREE, INITIALIZE };
enum { OK, WARNING, DISCARD, ERROR };

typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
    Logger logger;
    void *allocate, *release, *finished, *environment;
} Callbacks;
typedef struct {
    double values[COUNT];
    int steps;
    char name[128];
    const Callbacks *callbacks;
} Faulty;

static void fail(Faulty *me, int fault) {
    if (fault == NONE) {
        return;
    }
    me->callbacks->logger(me->callbacks->environment, me->name, ERROR, "last words",
                          "this is fault %d", fault);
    if (fault == CRASH) {
#if defined _WIN32
        *(volatile int *)8 = 0;
#endif
        raise(SIGSEGV);
    } else if (fault == ABORT) {
        abort();
    } else if (fault == EXIT) {
        exit(0);
    } else if (fault == CLOSE) {
        for (int descriptor = 3; descriptor < 1024; descriptor++) { /* that of the worker, too */
            close(descriptor);
        }
    }
    if (fault == LEAK) {
        char *volatile lost = malloc(1 << 18); /* or else the compiler leaves it out */
        memset(lost, 1, 1 << 18);
    }
    if (fault == PAUSE) {
        usleep(200000);
    }
    for (volatile bool hanging = fault == HANG; hanging;) {
        usleep(1000);
    }
}

static int pass(Faulty *me, int stage) {
    fail(me, (int)me->values[STAGE] == stage ? (int)me->values[FAULT] : NONE);
    return OK;
}

void *fmi2Instantiate(const char *name, int type, const char *token, const char *location,
                      const Callbacks *callbacks, int visible, int logging) {
    Faulty *me = calloc(1, sizeof *me);
    snprintf(me->name, sizeof me->name, "%s", name);
    me->callbacks = callbacks;
    if (strcmp(token, "{lonely}") == 0) {
        if (getenv("LONELY") != NULL) {
            free(me);
            return NULL;
        }
        setenv("LONELY", "1", 1);
    } else {
        fail(me, atoi(token + strlen("{faulty-")));
    }
    return me;
}

void fmi2FreeInstance(Faulty *me) {
    unsetenv("LONELY");
    pass(me, FREE);
    free(me);
}

int fmi2SetupExperiment(Faulty *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    return OK;
}

int fmi2EnterInitializationMode(Faulty *me) {
    return OK;
}

int fmi2ExitInitializationMode(Faulty *me) {
    return pass(me, INITIALIZE);
}

int fmi2Terminate(Faulty *me) {
    return pass(me, TERMINATE);
}

int fmi2Reset(Faulty *me) {
    pass(me, RESET);
    memset(me->values, 0, sizeof me->values);
    me->steps = 0;
    return OK;
}

int fmi2DoStep(Faulty *me, double time, double step_size, int no_set_state) {
    if (++me->steps == (int)me->values[AT]) {
        pass(me, STEP);
    }
    me->values[Y] += step_size * me->values[U];
    return OK;
}

int fmi2GetReal(Faulty *me, const unsigned *references, size_t count, double *values) {
    for (size_t i = 0; i < count; i++) {
        values[i] = me->values[references[i]];
    }
    return OK;
}

int fmi2SetReal(Faulty *me, const unsigned *references, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        me->values[references[i]] = values[i];
    }
    return OK;
}

int fmi2GetFMUstate(Faulty *me, void **state) {
    *state = malloc(sizeof *me);
    memcpy(*state, me, sizeof *me);
    return OK;
}

int fmi2SetFMUstate(Faulty *me, void *state) {
    memcpy(me, state, sizeof *me);
    return OK;
}

int fmi2FreeFMUstate(Faulty *me, void **state) {
    free(*state);
    *state = NULL;
    return OK;
}
