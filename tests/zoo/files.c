/* An FMU that uses files of its working directory, as models do that write results or read tables.

   Reals: 0 "u" (input), 1 "y" (output, the integral of u), 2 "gain" (output: the number in the file
   tables/gain.txt, 0 without it), 3 "lines" (output: how many lines the file result.csv has, of which
   each step writes one). A file NAME.log, for the name of the instance, has a line for each step, too. */

#include "zoo.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { U, Y, GAIN, LINES, VALUES };

struct Animal {
    double values[VALUES];
    char log[200];
};

static void append_line(const char *name, const char *mode, double value) {
    FILE *file = fopen(name, mode);

    if (file != NULL) {
        fprintf(file, "%g\n", value);
        fclose(file);
    }
}

static int count_lines(const char *name) {
    FILE *file = fopen(name, "r");
    int lines = 0;

    for (int c; file != NULL && (c = fgetc(file)) != EOF;) {
        lines += c == '\n';
    }
    if (file != NULL) {
        fclose(file);
    }
    return lines;
}

Animal *zoo_instantiate(const Birth *birth) {
    Animal *me = calloc(1, sizeof *me);

    snprintf(me->log, sizeof me->log, "%s.log", birth->name);
    return me;
}

void zoo_free(Animal *me) {
    free(me);
}

int zoo_exit(Animal *me) {
    FILE *table = fopen("tables/gain.txt", "r");

    remove("result.csv");
    if (table != NULL) {
        if (fscanf(table, "%lf", &me->values[GAIN]) != 1) {
            me->values[GAIN] = -1.0;
        }
        fclose(table);
    }
    return OK;
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    me->values[Y] += step_size * me->values[U];
    append_line("result.csv", "a", me->values[Y]);
    append_line(me->log, "a", me->values[Y]);
    me->values[LINES] = count_lines("result.csv");
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
    memset(me->values, 0, sizeof me->values);
    return OK;
}
