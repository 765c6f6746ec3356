/* An FMU that reads the number in the file y.txt of its resources, its only output. */

#include "zoo.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct Animal {
    double y;
};

/* Of a URI, what comes before the path; on Windows a path begins with its drive. */
#if defined _WIN32
#define BEFORE_PATH "file:///"
#else
#define BEFORE_PATH "file://"
#endif

/* A location is a path, or a URI of the form file:///PATH. */
static void name_file(const char *location, char *name, size_t size) {
    const size_t length = strlen(BEFORE_PATH);
    const char *path = strncmp(location, BEFORE_PATH, length) == 0 ? location + length : location;

    snprintf(name, size, "%s/%sy.txt", path, FMI_VERSION == 1 ? "resources/" : "");
}

Animal *zoo_instantiate(const Birth *birth) {
    Animal *me = calloc(1, sizeof *me);
    char name[4096];

    name_file(birth->location, name, sizeof name);
    FILE *file = fopen(name, "r");
    const bool read = file != NULL && fscanf(file, "%lf", &me->y) == 1;
    if (file != NULL) {
        fclose(file);
    }
    if (!read) {
        free(me);
        return NULL;
    }
    return me;
}

void zoo_free(Animal *me) {
    free(me);
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    return OK;
}

int zoo_get(Animal *me, const unsigned *references, size_t count, double *values) {
    zoo_read(&me->y, references, count, values);
    return OK;
}

int zoo_set(Animal *me, const unsigned *references, size_t count, const double *values) {
    return count == 0 ? OK : ERROR;
}

int zoo_reset(Animal *me) {
    return OK;
}
