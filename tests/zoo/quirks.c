/* Useful FMUs that break one promise each: the instantiation token names it.

   x' = gain u - x / tau and y = x, by explicit Euler with internal steps of 1 ms. "clock" is what
   the FMU takes for the time since the start, "calls" counts the steps, and "returns" tells whether
   states of earlier times may be restored, as the last step was told. */

#define _GNU_SOURCE
#include "zoo.h"

#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum variable { U, Y, GAIN, TAU, CLOCK, CALLS, RETURNS, VARIABLES };

enum { NUMBERS = 8, OVERRUN = 16, MEMORY = 1000, SLOTS = 2 };

struct Animal {
    double values[VARIABLES];
    double x, first_gain, sign;
    int resets, number;
    bool ready, hangs, stopped, stepped;
    char token[40], folder[PATH_MAX];
    double *numbers; /* a block of memory of its own */
    double *block;   /* one that it may share */
    double memory[MEMORY];
    int place;
};

/* A model on the heap, for those that keep only a pointer to it in their library. */
typedef struct {
    double x, gain, time, buffer;
} Model;

/* What instances of one library share. */
static double shared_x, shared_gain, shared_drift, buffer, shared_time;
static double shared_memory[MEMORY];
static int shared_place;
static unsigned shared_seed;
static Animal saved, *newest;
static Model *model;
static double *block, *slots;
static int made, in_use;
static bool read_beside_library;

static bool is(const Animal *me, const char *token) {
    return strcmp(me->token, token) == 0;
}

/* As libraries do that expect to be loaded from their own folder. */
__attribute__((constructor)) static void read_data(void) {
    read_beside_library = access("Zoo.txt", R_OK) == 0;
}

static void set_start(Animal *me) {
    memset(me->values, 0, sizeof me->values);
    me->values[GAIN] = shared_gain = 1.0;
    me->values[TAU] = 0.5;
    me->x = 0.0;
    me->sign = 1.0;
    me->ready = me->hangs = me->stopped = false;
}

static void path_of(const Animal *me, const char *name, char *path, size_t size) {
    snprintf(path, size, "%s/%s", me->folder, name);
}

static bool write_number(const char *path, double number) {
    FILE *file = fopen(path, "w");

    if (file != NULL) {
        fprintf(file, "%a", number);
        fclose(file);
    }
    return file != NULL;
}

static bool read_number(const char *path, double *number) {
    FILE *file = fopen(path, "r");
    const bool found = file != NULL && fscanf(file, "%la", number) == 1;

    if (file != NULL) {
        fclose(file);
    }
    return found;
}

/* Where the FMU writes what it reads again later; empty if it needs no such file. */
static void find_scratch(const Animal *me, char *path, size_t size) {
    path[0] = '\0';
    if (is(me, "scratch file") || is(me, "reset keeps files")) {
        path_of(me, "scratch.txt", path, size);
    } else if (is(me, "scratch in directory")) {
        snprintf(path, size, "scratch.txt");
    }
}

static bool refuses(const Animal *me) {
    return (is(me, "one in a process") && made > 0) ||
           (is(me, "needs its directory") && !read_beside_library) ||
           (is(me, "changes directory") && chdir(me->folder) != 0);
}

Animal *zoo_instantiate(const Birth *birth) {
    Animal *me = calloc(1, sizeof *me);
    const char *path = birth->location + (strncmp(birth->location, "file://", 7) == 0 ? 7 : 0);

    snprintf(me->token, sizeof me->token, "%s", birth->token);
    snprintf(me->folder, sizeof me->folder, "%s%s", path, FMI_VERSION == 1 ? "/resources" : "");
    if (refuses(me)) {
        free(me);
        return NULL;
    }
    set_start(me);
    me->numbers = calloc(NUMBERS, sizeof *me->numbers);
    model = model == NULL ? calloc(1, sizeof *model) : model;
    slots = slots == NULL ? calloc(SLOTS, sizeof *slots) : slots;
    me->number = made++;
    in_use++;
    return me;
}

void zoo_free(Animal *me) {
    if ((is(me, "free before a step") && !me->stepped) ||
        (is(me, "free before initialization") && !me->ready)) {
        me->numbers++; /* no longer what the heap knows */
    }
    in_use--;
    if (is(me, "free disturbs") && newest != NULL && newest != me) {
        newest->x = 0.0;
    }
    newest = newest == me ? NULL : newest;
    free(me->numbers);
    free(me);
}

static bool prepare(Animal *me) {
    char path[PATH_MAX + 20];

    find_scratch(me, path, sizeof path);
    if (is(me, "strtok")) {
        return zoo_parse_table();
    }
    if (is(me, "reads a table")) {
        path_of(me, "tables/offset.txt", path, sizeof path);
        return read_number(path, &me->x);
    }
    if (is(me, "reset keeps files")) {
        read_number(path, &me->x);
    } else if (path[0] != '\0') {
        return write_number(path, me->values[GAIN]);
    }
    return true;
}

int zoo_exit(Animal *me) {
    const bool prepared = prepare(me);

    shared_x = me->x;
    shared_time = 0.0;
    shared_seed = 1;
    *model = (Model){.gain = me->values[GAIN]};
    newest = me;
    if (is(me, "initialized together")) {
        me->block = block = block == NULL ? calloc(1, sizeof *block) : block;
    }
    slots[me->number % SLOTS] = me->x;
    me->first_gain = me->resets == 0 ? me->values[GAIN] : me->first_gain;
    me->ready = true;
    if (!is(me, "reset keeps outputs")) {
        me->values[Y] = me->x;
    }
    return prepared ? OK : ERROR;
}

/* The gain as it is found in each step. */
static double find_gain(Animal *me) {
    char path[PATH_MAX + 20];
    double gain = me->values[GAIN];

    if (is(me, "global parameters")) {
        gain = shared_gain;
    } else if (is(me, "reset ignores parameters")) {
        gain = me->first_gain;
    }
    find_scratch(me, path, sizeof path);
    if (path[0] != '\0' && !is(me, "reset keeps files")) {
        read_number(path, &gain);
    }
    return gain;
}

/* The state as it is found in each step. */
static double *find_state(Animal *me) {
    if (is(me, "globals")) {
        return &shared_x;
    } else if (is(me, "initialized together")) {
        block = NULL; /* those that are initialized from now on get another one */
        return me->block;
    }
    return is(me, "two slots") ? &slots[me->number % SLOTS] : &me->x;
}

/* Pass a number through memory that others use, too. */
static double passed(double number, double *through) {
    *through = number;
    usleep(20);
    return *through;
}

/* What came in a number of steps before. */
static double delayed(double *memory, int *place, double number) {
    const double before = memory[*place];

    memory[*place] = number;
    *place = (*place + 1) % MEMORY;
    return before;
}

/* One model for all: it steps only if the time is later than its own. */
static void step_model(Animal *me, double step_size, double gain) {
    const double time = me->values[CLOCK] + step_size;

    if (time > model->time) {
        model->x += step_size * (gain * me->values[U] - model->x / me->values[TAU]);
        model->time = time;
    }
    me->values[Y] = model->x;
}

static void integrate(Animal *me, double step_size) {
    double *x = find_state(me);
    const double gain = find_gain(me);
    int steps = (int)(step_size * 1000.0 + 0.5);

    if (is(me, "heap model")) {
        step_model(me, step_size, gain);
        return;
    }
    if (is(me, "static buffer")) {
        *x = passed(*x, &buffer);
    } else if (is(me, "heap buffer")) {
        *x = passed(*x, &model->buffer);
    } else if (is(me, "static time")) {
        steps = (int)((me->values[CLOCK] + step_size - shared_time) * 1000.0 + 0.5);
        shared_time = me->values[CLOCK] + step_size;
    } else if (is(me, "static random numbers")) {
        shared_seed = shared_seed * 1103515245u + 12345u;
        *x += 1e-9 * (shared_seed >> 16);
    } else if (is(me, "counts instances")) {
        *x += 0.001 * (in_use - 1);
    } else if (is(me, "newest turns") && me->values[CLOCK] >= 1.0 - 1e-9) {
        newest->sign = -1.0;
    }
    for (int i = 0; i < steps; i++) {
        *x += 0.001 * (gain * me->values[U] - *x / me->values[TAU]);
    }
    if (is(me, "library keeps")) {
        shared_drift += 0.001;
        *x += shared_drift;
    } else if (is(me, "noise")) {
        *x += 1e-9 * (double)(rand() % 100);
    }
    me->values[Y] = model->buffer = me->sign * *x;
    if (is(me, "long memory of the library")) {
        me->values[Y] += delayed(shared_memory, &shared_place, *x);
    } else if (is(me, "long memory")) {
        me->values[Y] += delayed(me->memory, &me->place, *x);
    }
}

static void corrupt(Animal *me) {
    char path[PATH_MAX + 20];

    if (is(me, "overruns")) {
        ((char *)me->numbers)[NUMBERS * sizeof *me->numbers] = 1; /* padding: often harmless */
    } else if (is(me, "overruns with two") && in_use > 1) {
        memset(me->numbers + NUMBERS, 1, OVERRUN);
    }
    if (is(me, "reset keeps files")) {
        find_scratch(me, path, sizeof path);
        write_number(path, me->x);
    }
}

static double processor_time(void) {
    struct timespec now;

    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

bool zoo_stops(const Animal *me) {
    return me->stopped;
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    while (me->hangs) {
        sleep(1);
    }
    me->stepped = true;
    if (is(me, "stops, slow at first") && me->values[CALLS] == 0.0) {
        usleep(200000); /* as a library does that loads its data then */
    }
    if (!me->stopped) {
        integrate(me, step_size);
        corrupt(me);
        me->values[RETURNS] = !no_set_state;
        me->values[CLOCK] += step_size;
        me->values[CALLS] = is(me, "tells its time") ? processor_time() : me->values[CALLS] + 1.0;
        me->stopped = strncmp(me->token, "stops", 5) == 0 && me->values[CLOCK] >= 0.35;
    }
    if (is(me, "warns") && me->resets == 0) {
        return WARNING;
    }
    return me->stopped && FMI_VERSION == 2 ? DISCARD : OK;
}

/* Whether a variable that cannot be read is among those that are asked for. */
static bool asks_in_vain(const Animal *me, const unsigned *references, size_t count) {
    for (size_t i = 0; i < count; i++) {
        if ((is(me, "no reading of inputs") && references[i] == U) ||
            (is(me, "no reading of parameters") && (references[i] == GAIN || references[i] == TAU)) ||
            (is(me, "no reading of calls") && references[i] == CALLS)) {
            return true;
        }
    }
    return false;
}

int zoo_get(Animal *me, const unsigned *references, size_t count, double *values) {
    zoo_read(me->values, references, count, values);
    for (size_t i = 0; i < count && is(me, "shared outputs"); i++) {
        values[i] = references[i] == Y ? model->buffer : values[i];
    }
    if (asks_in_vain(me, references, count)) {
        return ERROR;
    }
    if (is(me, "no early reading") && !me->ready) {
        return ERROR;
    }
    return is(me, "no reading before a step") && me->values[CALLS] == 0.0 ? ERROR : OK;
}

int zoo_set(Animal *me, const unsigned *references, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        me->values[references[i]] = values[i];
        if (references[i] == GAIN) {
            shared_gain = values[i];
            me->hangs = is(me, "second episode hangs") && me->resets > 0;
        }
    }
    return OK;
}

int zoo_reset(Animal *me) {
    const Animal before = *me;

    me->resets++;
    if (is(me, "reset does nothing")) {
        return OK;
    }
    if (is(me, "second reset fails") && me->resets > 1) {
        return ERROR;
    }
    set_start(me);
    if (is(me, "reset disturbs") && newest != NULL) {
        newest->x = 0.0;
    }
    if (is(me, "reset keeps the state")) {
        me->x = before.x;
    } else if (is(me, "reset keeps inputs")) {
        me->values[U] = before.values[U];
    } else if (is(me, "reset keeps outputs")) {
        me->values[Y] = before.values[Y];
    } else if (is(me, "reset keeps parameters")) {
        me->values[GAIN] = before.values[GAIN];
    } else if (is(me, "reset keeps the time")) {
        me->values[CLOCK] = before.values[CLOCK];
    } else if (is(me, "stops, reset keeps that") || is(me, "stops, slow at first")) {
        me->stopped = before.stopped;
    } else if (is(me, "reset frees twice")) {
        free(me->numbers);
    } else if (is(me, "reset is not exact")) {
        me->x = 1e-9 * before.values[CALLS];
    }
    return OK;
}

int zoo_get_state(Animal *me, void **state) {
    if (*state == NULL) {
        *state = malloc(sizeof *me);
    }
    memcpy(*state, me, sizeof *me);
    saved = *me;
    return OK;
}

int zoo_set_state(Animal *me, void *state) {
    const Animal before = *me;

    memcpy(me, is(me, "one saved state") ? &saved : state, sizeof *me);
    me->numbers = before.numbers;
    if (is(me, "restore forgets")) {
        me->x = me->values[Y] = before.x;
    } else if (is(me, "restore keeps the time")) {
        me->values[CLOCK] += 1.0;
    }
    return OK;
}
