/* What models do who care about other things: weak functions, which those of a model replace. */

#define _GNU_SOURCE
#include "zoo.h"

#include <stdlib.h>
#include <string.h>
#include <unistd.h>

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

bool zoo_parse_table(void) {
    int rows = 0;
    char table[400] = "";

    for (int i = 0; i < 40; i++) {
        strcat(table, "12 34;");
    }
    for (char *row = strtok(table, ";"); row != NULL; row = strtok(NULL, ";")) {
        rows++;
        usleep(20);
    }
    return rows == 40;
}

void zoo_read(const double *from, const unsigned *references, size_t count, double *to) {
    for (size_t i = 0; i < count; i++) {
        to[i] = from[references[i]];
    }
}

void zoo_write(double *to, const unsigned *references, size_t count, const double *from) {
    for (size_t i = 0; i < count; i++) {
        to[references[i]] = from[i];
    }
}
