/* Useful FMUs that demand something: the instantiation token says what.

   x' = gain u - x, y = x, by explicit Euler with internal steps of 1 ms.
   Reals: 0 "u" (input), 1 "y" (output), 2 "gain" (parameter).

   The environment variable LICENCES names a file that has the process of each licence in use, and
   LICENCES_LIMIT says how many there may be. LICENCES.most gets the most that were in use at once. */

#define _GNU_SOURCE
#include "zoo.h"

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

enum { U, Y, GAIN, VALUES, MOST_LICENCES = 64 };

struct Animal {
    double values[VALUES];
    char token[40];
    char name[80];
    Logger logger;
    void *environment;
    bool licensed;
};

static bool is_licensed(void) {
    const char *licences = getenv("LICENCES");
    return licences != NULL && *licences != '\0';
}

static void note_most(int most) {
    char path[400];
    snprintf(path, sizeof path, "%s.most", getenv("LICENCES"));
    FILE *file = fopen(path, "a");
    fprintf(file, "%d\n", most);
    fclose(file);
}

/* Reads the processes that have licences, without those that have ended. */
static int read_licences(int file, pid_t *licences) {
    const int all = (int)(pread(file, licences, MOST_LICENCES * sizeof *licences, 0) / sizeof *licences);
    int alive = 0;

    for (int i = 0; i < all; i++) {
        if (kill(licences[i], 0) == 0 || errno != ESRCH) {
            licences[alive++] = licences[i];
        }
    }
    return alive;
}

/* Adds a licence of this process, or takes one away; returns whether that was possible. */
static bool change_licences(bool taken) {
    static int most;
    pid_t licences[MOST_LICENCES + 1];
    const int file = open(getenv("LICENCES"), O_RDWR | O_CREAT, 0600);

    flock(file, LOCK_EX);
    int count = read_licences(file, licences);
    const bool possible = !taken || count < atoi(getenv("LICENCES_LIMIT"));
    if (taken && possible) {
        licences[count++] = getpid();
    }
    for (int i = 0; i < count && !taken; i++) {
        if (licences[i] == getpid()) {
            licences[i] = licences[--count];
            break;
        }
    }
    if (count > most) {
        most = count;
        note_most(most);
    }
    ftruncate(file, 0);
    pwrite(file, licences, count * sizeof *licences, 0);
    close(file);
    return possible;
}

static bool take_licence(Animal *me) {
    if (!is_licensed() || me->licensed) {
        return true;
    }
    me->licensed = change_licences(true);
    if (!me->licensed) {
        me->logger(me->environment, me->name, ERROR, "error",
                   "FLEXlm error -4: checkout of Demanding failed, all %s seats taken",
                   getenv("LICENCES_LIMIT"));
    }
    return me->licensed;
}

static double buffer; /* of steps that are not safe in threads */

static void sleep_for(double seconds) {
    const struct timespec time = {(time_t)seconds, (long)(1e9 * (seconds - (time_t)seconds))};
    nanosleep(&time, NULL);
}

static bool is(const Animal *me, const char *token) {
    return strcmp(me->token, token) == 0;
}

static void set_start(Animal *me) {
    memset(me->values, 0, sizeof me->values);
    me->values[GAIN] = 1.0;
}

Animal *zoo_instantiate(const Birth *birth) {
    Animal *me = calloc(1, sizeof *me);

    snprintf(me->token, sizeof me->token, "%s", birth->token);
    snprintf(me->name, sizeof me->name, "%s", birth->name);
    me->logger = birth->logger;
    me->environment = birth->environment;
    set_start(me);
    if (!is(me, "licensed at initialization") && !take_licence(me)) {
        if (is(me, "licensed or dead")) {
            abort();
        }
        free(me);
        return NULL;
    }
    return me;
}

void zoo_free(Animal *me) {
    if (me->licensed) {
        change_licences(false);
    }
    free(me);
}

int zoo_exit(Animal *me) {
    if (!take_licence(me)) {
        return ERROR;
    }
    if (strncmp(me->token, "slow", 4) == 0) {
        me->logger(me->environment, me->name, ERROR, "info", "solving %d equations", 4711);
        sleep_for(is(me, "slow for ever") ? 3600.0 : is(me, "slower") ? 0.75 : 0.15);
    }
    return is(me, "strtok") && !zoo_parse_table() ? ERROR : OK;
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    double *v = me->values;
    const int steps = (int)(step_size * 1000.0 + 0.5);

    if (is(me, "hangs in a step")) {
        sleep_for(3600.0);
    }
    for (int i = 0; i < steps; i++) {
        const double slope = v[GAIN] * v[U] - v[Y];
        if (is(me, "static buffer") && i % 8 == 0) {
            buffer = slope;
            usleep(20);
            v[Y] += 0.001 * buffer;
        } else {
            v[Y] += 0.001 * slope;
        }
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
    memcpy(me->values, ((Animal *)state)->values, sizeof me->values);
    return OK;
}

typedef struct {
    double values[VALUES];
    pid_t process;
} Bytes;

int zoo_size_of_bytes(Animal *me, void *state, size_t *size) {
    *size = sizeof(Bytes);
    return OK;
}

int zoo_to_bytes(Animal *me, void *state, char *bytes, size_t size) {
    Bytes content;

    memset(&content, 0, sizeof content);
    memcpy(content.values, ((Animal *)state)->values, sizeof content.values);
    content.process = strchr(me->token, ',') == NULL ? 0 : getpid();
    memcpy(bytes, &content, size);
    return OK;
}

int zoo_from_bytes(Animal *me, const char *bytes, size_t size, void **state) {
    Bytes content;

    memcpy(&content, bytes, sizeof content);
    if (is(me, "slow, crashes elsewhere") && content.process != getpid()) {
        abort();
    }
    if (is(me, "slow, refuses elsewhere") && content.process != getpid()) {
        return ERROR;
    }
    zoo_get_state(me, state);
    memcpy(((Animal *)*state)->values, content.values, sizeof content.values);
    if (is(me, "slow, differs elsewhere") && content.process != getpid()) {
        ((Animal *)*state)->values[GAIN] += 1e-9;
    }
    return OK;
}
