/* FMUs for tests of first meetings: what they do is in their token.

   Reals: 0 "u" (input), 1 "y" (output). Lines go to standard output and to the FMI logger. */

#define _GNU_SOURCE
#include "zoo.h"

#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { NUMBERS = 512, HARMLESS_STEPS = 15, HARMLESS_RESETS = 2 };

struct Animal {
    double values[2];
    char token[32];
    double *numbers; /* a block of memory of its own */
    double *beside;  /* most likely the next block, so that what is beyond the first one is ours */
    int steps, resets;
};

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

Animal *zoo_instantiate(const Birth *birth) {
    const char *token = birth->token;
    instances++;
    if (strcmp(token, "licence") == 0) {
        birth->logger(NULL, birth->name, ERROR, "licence", "no licence for %d seats", 5);
        printf("so much for the licence\n"); /* not flushed */
        abort();
    }
    if (strcmp(token, "refuse") == 0) {
        birth->logger(NULL, birth->name, ERROR, "licence", "all %d seats are taken", 5);
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
    Animal *me = calloc(1, sizeof *me);
    snprintf(me->token, sizeof me->token, "%s", token);
    me->numbers = calloc(NUMBERS, sizeof *me->numbers);
    me->beside = calloc(NUMBERS, sizeof *me->beside);
    shared = shared == NULL ? malloc(NUMBERS) : shared;
    return me;
}

void zoo_free(Animal *me) {
    do_as_told(me->token, "free");
    if (strcmp(me->token, "free what is shared") == 0) {
        free(shared);
    }
    free(me->numbers);
    free(me->beside);
    free(me);
}

int zoo_call(Animal *me, enum call call) {
    return call == ENTER && strcmp(me->token, "needy") == 0 ? ERROR : OK;
}

int zoo_exit(Animal *me) {
    do_as_told(me->token, "initialization");
    return OK;
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    do_as_told(me->token, "step");
    me->values[1] = me->values[0];
    me->steps++;
    if (me->steps > HARMLESS_STEPS) {
        do_as_told(me->token, "a later step");
    }
    if (strcmp(me->token, "overrun later") == 0 && me->steps > HARMLESS_STEPS) {
        memset(me->numbers + NUMBERS, 1, 64);
    }
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

int zoo_reset(Animal *me) {
    if (++me->resets > HARMLESS_RESETS) {
        do_as_told(me->token, "a later reset");
    }
    me->values[0] = me->values[1] = 0.0;
    return OK;
}
