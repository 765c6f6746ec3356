/* FMUs whose steps work in writable data of the library, which all instances share.

   x' = gain u - x, y = x, by explicit Euler with internal steps of 1 ms.
   Reals: 0 "u" (input), 1 "y" (output), 2 "gain" (parameter). */

#include "zoo.h"

#include <stdlib.h>
#include <string.h>

enum { U, Y, GAIN, VALUES };

struct Animal {
    double values[VALUES];
};

/* One of the other files. The name and the arguments are those of a Fortran subroutine. */
void integrate_(double *x, const double *gain, const double *u, const int *steps);

static void set_start(Animal *me) {
    memset(me->values, 0, sizeof me->values);
    me->values[GAIN] = 1.0;
}

Animal *zoo_instantiate(const Birth *birth) {
    Animal *me = malloc(sizeof *me);

    set_start(me);
    return me;
}

void zoo_free(Animal *me) {
    free(me);
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    const int steps = (int)(step_size * 1000.0 + 0.5);

    integrate_(&me->values[Y], &me->values[GAIN], &me->values[U], &steps);
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
    set_start(me);
    return OK;
}

int zoo_get_state(Animal *me, void **state) {
    if (*state == NULL) {
        *state = malloc(sizeof *me);
    }
    memcpy(*state, me, sizeof *me);
    return OK;
}

int zoo_set_state(Animal *me, void *state) {
    memcpy(me, state, sizeof *me);
    return OK;
}
