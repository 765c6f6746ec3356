/* What models do who care about other things: weak functions, which those of a model replace. */

#include "zoo.h"

#include <stdlib.h>

#define USUAL __attribute__((weak))

USUAL int zoo_call(Animal *me, enum call call) {
    return OK;
}

USUAL int zoo_enter(Animal *me) {
    return OK;
}

USUAL int zoo_exit(Animal *me) {
    return OK;
}

USUAL int zoo_initialize(Animal *me) {
    const int status = zoo_enter(me);

    return status == OK ? zoo_exit(me) : status;
}

USUAL bool zoo_stops(const Animal *me) {
    return false;
}

USUAL int zoo_listen(Animal *me, bool on, size_t count, const char *const *categories) {
    return ERROR;
}

USUAL int zoo_get_state(Animal *me, void **state) {
    return ERROR;
}

USUAL int zoo_set_state(Animal *me, void *state) {
    return ERROR;
}

USUAL int zoo_free_state(void **state) {
    free(*state);
    *state = NULL;
    return OK;
}

USUAL int zoo_size_of_bytes(Animal *me, void *state, size_t *size) {
    return ERROR;
}

USUAL int zoo_to_bytes(Animal *me, void *state, char *bytes, size_t size) {
    return ERROR;
}

USUAL int zoo_from_bytes(Animal *me, const char *bytes, size_t size, void **state) {
    return ERROR;
}
