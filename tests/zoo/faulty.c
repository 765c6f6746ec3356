/* FMUs that do to their process what they are told, where they are told.

   y' = u. The parameter "fault" is what happens (see enum fault), "stage" where (see enum call), and
   "at" the step for STEP. Parameters come too late for instantiation: there a token "{faulty-F}" asks
   for fault F. "lonely" counts instances in the process's environment, where a copy of the library
   finds them too. */

#define _GNU_SOURCE
#include "zoo.h"

#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#if defined _WIN32
#define setenv(name, value, overwrite) _putenv_s(name, value)
#define unsetenv(name) _putenv_s(name, "")
#endif

enum variable { U, Y, FAULT, STAGE, AT, VARIABLES };
enum fault {
    NONE, CRASH, ABORT, LEAVE, HANG, CLOSE, PAUSE, LEAK, SCRIBBLE,
    TRACED, TRACED_BY_CHILD, TRACED_AND_STOP, TRACED_AND_CRASH
};

struct Animal {
    double values[VARIABLES];
    int steps;
    char name[128];
    Logger logger;
    void *environment;
};

#if defined __linux__

#include <sys/ptrace.h>
#include <sys/wait.h>

/* A fork that holds this process, as libraries do that want no debugger. */
static void let_a_child_trace(void) {
    const pid_t me = getpid(), child = fork();

    if (child == 0) {
        ptrace(PTRACE_SEIZE, me, NULL, NULL);
        for (;;) {
            pause();
        }
    }
    usleep(100000);
}

static void let_trace(int fault) {
    if (fault == TRACED_BY_CHILD) {
        let_a_child_trace();
    } else {
        ptrace(PTRACE_TRACEME, 0, NULL, NULL);
    }
    if (fault == TRACED_AND_STOP) {
        raise(SIGSTOP);
    } else if (fault == TRACED_AND_CRASH) {
        raise(SIGSEGV);
    }
}

#else

static void let_trace(int fault) {
}

#endif

/* Writes to descriptors that are not its own. */
static void scribble(void) {
    char bytes[2048];

    memset(bytes, 0x40, sizeof bytes);
    for (int descriptor = 3; descriptor < 512; descriptor++) {
        if (write(descriptor, bytes, sizeof bytes) < 0) {
            continue;
        }
    }
}

static void fail(Animal *me, int fault) {
    if (fault == NONE) {
        return;
    }
    if (fault == SCRIBBLE) {
        scribble();
        return;
    }
    me->logger(me->environment, me->name, ERROR, "last words", "this is fault %d", fault);
    if (fault == CRASH) {
#if defined _WIN32
        *(volatile int *)8 = 0;
#endif
        raise(SIGSEGV);
    } else if (fault == ABORT) {
        abort();
    } else if (fault == LEAVE) {
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
    if (fault >= TRACED) {
        let_trace(fault);
    }
    for (volatile bool hanging = fault == HANG || fault >= TRACED; hanging;) {
        usleep(1000);
    }
}

int zoo_call(Animal *me, enum call call) {
    fail(me, (int)me->values[STAGE] == (int)call ? (int)me->values[FAULT] : NONE);
    return OK;
}

Animal *zoo_instantiate(const Birth *birth) {
    Animal *me = calloc(1, sizeof *me);
    snprintf(me->name, sizeof me->name, "%s", birth->name);
    me->logger = birth->logger;
    me->environment = birth->environment;
    if (strcmp(birth->token, "{lonely}") == 0) {
        if (getenv("LONELY") != NULL) {
            free(me);
            return NULL;
        }
        setenv("LONELY", "1", 1);
    } else {
        fail(me, atoi(birth->token + strlen("{faulty-")));
    }
    return me;
}

void zoo_free(Animal *me) {
    unsetenv("LONELY");
    zoo_call(me, FREE);
    free(me);
}

int zoo_exit(Animal *me) {
    return zoo_call(me, EXIT);
}

int zoo_reset(Animal *me) {
    zoo_call(me, RESET);
    memset(me->values, 0, sizeof me->values);
    me->steps = 0;
    return OK;
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    if (++me->steps == (int)me->values[AT]) {
        zoo_call(me, STEP);
    }
    me->values[Y] += step_size * me->values[U];
    return OK;
}

int zoo_get(Animal *me, const unsigned *references, size_t count, double *values) {
    zoo_read(me->values, references, count, values);
    return OK;
}

int zoo_set(Animal *me, const unsigned *references, size_t count, const double *values) {
    zoo_write(me->values, references, count, values);
    return OK;
}

int zoo_get_state(Animal *me, void **state) {
    *state = malloc(sizeof *me);
    memcpy(*state, me, sizeof *me);
    return OK;
}

int zoo_set_state(Animal *me, void *state) {
    memcpy(me, state, sizeof *me);
    return OK;
}
