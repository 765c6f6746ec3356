/* An FMU that makes 20 instances, and then no further one: the token says with what it does so, its
   "library" or its "process". Reals: 0 "u" (input), 1 "y" (output, the integral of u). */

#define _GNU_SOURCE
#include "zoo.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MOST = 20 };

struct Animal {
    double values[2];
};

static int made;

/* Counts in the environment variables of the process, where copies of the library find it, too. */
static int count_in_process(void) {
    char text[20];
    const char *before = getenv("MADE_BY_LIMITED");
    const int number = 1 + (before == NULL ? 0 : atoi(before));

    snprintf(text, sizeof text, "%d", number);
    setenv("MADE_BY_LIMITED", text, 1);
    return number;
}

Animal *zoo_instantiate(const Birth *birth) {
    const int number = strcmp(birth->token, "process") == 0 ? count_in_process() : ++made;

    return number > MOST ? NULL : calloc(1, sizeof(Animal));
}

void zoo_free(Animal *me) {
    free(me);
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    me->values[1] += step_size * me->values[0];
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
    return OK;
}
