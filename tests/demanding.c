/* A useful FMU of FMI 2.0 that demands something: what is in its token.

   x' = gain u - x, y = x, by explicit Euler with internal steps of 1 ms.
   Reals: 0 "u" (input), 1 "y" (output), 2 "gain" (parameter).

   The environment variable SEATS names a file that has the process of each licence in use, and
   SEATS_LIMIT says how many there may be. SEATS.most gets the most that were in use at once,
   SEATS.calls the time of each instantiation and initialization. */

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

#define OWN_SERIALIZATION
#include "fmi2_stubs.h"

enum { U, Y, GAIN, VALUES, MOST_SEATS = 64 };

typedef struct {
    void (*logger)(void *, const char *, int, const char *, const char *, ...);
} Callbacks;

typedef struct {
    double values[VALUES];
    char token[40];
    char name[80];
    const Callbacks *callbacks;
    int seated;
} Model;

static int is_licensed(void) {
    const char *seats = getenv("SEATS");
    return seats != NULL && *seats != '\0';
}

static void note(const char *suffix, double value, int append) {
    char path[400];
    snprintf(path, sizeof path, "%s.%s", getenv("SEATS"), suffix);
    FILE *file = fopen(path, append ? "a" : "w");
    fprintf(file, "%.6f\n", value);
    fclose(file);
}

static void note_call(void) {
    struct timespec now;

    if (is_licensed()) {
        clock_gettime(CLOCK_MONOTONIC, &now);
        note("calls", (double)now.tv_sec + 1e-9 * (double)now.tv_nsec, 1);
    }
}

/* Reads the processes that have seats, without those that have ended. */
static int read_seats(int file, pid_t *seats) {
    const int all = (int)(pread(file, seats, MOST_SEATS * sizeof *seats, 0) / sizeof *seats);
    int alive = 0;

    for (int i = 0; i < all; i++) {
        if (kill(seats[i], 0) == 0 || errno != ESRCH) {
            seats[alive++] = seats[i];
        }
    }
    return alive;
}

/* Adds a seat of this process, or takes one away; returns whether that was possible. */
static int change_seats(int taken) {
    static int most;
    pid_t seats[MOST_SEATS + 1];
    const int file = open(getenv("SEATS"), O_RDWR | O_CREAT, 0600);

    flock(file, LOCK_EX);
    int count = read_seats(file, seats);
    const int possible = !taken || count < atoi(getenv("SEATS_LIMIT"));
    if (taken && possible) {
        seats[count++] = getpid();
    }
    for (int i = 0; i < count && !taken; i++) {
        if (seats[i] == getpid()) {
            seats[i] = seats[--count];
            break;
        }
    }
    if (count > most) {
        most = count;
        note("most", most, 1);
    }
    ftruncate(file, 0);
    pwrite(file, seats, count * sizeof *seats, 0);
    close(file);
    return possible;
}

static int take_seat(Model *me) {
    if (!is_licensed() || me->seated) {
        return 1;
    }
    me->seated = change_seats(1);
    if (!me->seated) {
        me->callbacks->logger(NULL, me->name, 3, "error",
                              "FLEXlm error -4: checkout of Demanding failed, all %s seats taken",
                              getenv("SEATS_LIMIT"));
    }
    return me->seated;
}

static double buffer; /* of steps that are not safe in threads */

static void sleep_for(double seconds) {
    const struct timespec time = {(time_t)seconds, (long)(1e9 * (seconds - (time_t)seconds))};
    nanosleep(&time, NULL);
}

static int is(const Model *me, const char *token) {
    return strcmp(me->token, token) == 0;
}

static void set_start(Model *me) {
    memset(me->values, 0, sizeof me->values);
    me->values[GAIN] = 1.0;
}

void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                      const Callbacks *callbacks, int visible, int logging) {
    Model *me = calloc(1, sizeof *me);

    note_call();
    snprintf(me->token, sizeof me->token, "%s", token);
    snprintf(me->name, sizeof me->name, "%s", name);
    me->callbacks = callbacks;
    set_start(me);
    if (!is(me, "licensed at initialization") && !take_seat(me)) {
        if (is(me, "licensed or dead")) {
            abort();
        }
        free(me);
        return NULL;
    }
    return me;
}

void fmi2FreeInstance(Model *me) {
    if (me->seated) {
        change_seats(0);
    }
    free(me);
}

int fmi2SetupExperiment(Model *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    return 0;
}

/* Reads a table as JModelica's weather models do: not safe in threads. */
static int read_table(void) {
    int rows = 0;
    char table[400] = "";

    for (int i = 0; i < 40; i++) {
        strcat(table, "12 34;");
    }
    for (char *row = strtok(table, ";"); row != NULL; row = strtok(NULL, ";")) {
        rows++;
        usleep(20);
    }
    return rows == 40 ? 0 : 3;
}

int fmi2EnterInitializationMode(Model *me) {
    return 0;
}

int fmi2ExitInitializationMode(Model *me) {
    note_call();
    if (!take_seat(me)) {
        return 3;
    }
    if (strncmp(me->token, "slow", 4) == 0) {
        me->callbacks->logger(NULL, me->name, 3, "info", "solving %d equations", 4711);
        sleep_for(is(me, "slow for ever") ? 3600.0 : is(me, "slower") ? 1.5 : 0.3);
    }
    return is(me, "strtok") ? read_table() : 0;
}

int fmi2DoStep(Model *me, double time, double step_size, int no_set_state) {
    double *v = me->values;
    const int steps = (int)(step_size * 1000.0 + 0.5);

    if (is(me, "hangs in a step")) {
        sleep_for(3600.0);
    }
    for (int i = 0; i < steps; i++) {
        buffer = v[GAIN] * v[U] - v[Y];
        if (is(me, "static buffer") && i % 8 == 0) {
            usleep(20);
            v[Y] += 0.001 * buffer;
        } else {
            v[Y] += 0.001 * (v[GAIN] * v[U] - v[Y]);
        }
    }
    return 0;
}

int fmi2GetReal(Model *me, const unsigned *vr, size_t count, double *values) {
    for (size_t i = 0; i < count; i++) {
        values[i] = me->values[vr[i]];
    }
    return 0;
}

int fmi2SetReal(Model *me, const unsigned *vr, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        me->values[vr[i]] = values[i];
    }
    return 0;
}

int fmi2Terminate(Model *me) {
    return 0;
}

int fmi2Reset(Model *me) {
    set_start(me);
    return 0;
}

int fmi2GetFMUstate(Model *me, void **state) {
    if (*state == NULL) {
        *state = malloc(sizeof *me);
    }
    memcpy(*state, me, sizeof *me);
    return 0;
}

int fmi2SetFMUstate(Model *me, void *state) {
    memcpy(me->values, ((Model *)state)->values, sizeof me->values);
    return 0;
}

typedef struct {
    double values[VALUES];
    pid_t process;
} Bytes;

int fmi2SerializedFMUstateSize(Model *me, void *state, size_t *size) {
    *size = sizeof(Bytes);
    return is(me, "slow, serializes nothing") ? 3 : 0;
}

int fmi2SerializeFMUstate(Model *me, void *state, char *bytes, size_t size) {
    Bytes content;

    memset(&content, 0, sizeof content);
    memcpy(content.values, ((Model *)state)->values, sizeof content.values);
    content.process = strchr(me->token, ',') == NULL ? 0 : getpid();
    memcpy(bytes, &content, size);
    return 0;
}

int fmi2DeSerializeFMUstate(Model *me, const char *bytes, size_t size, void **state) {
    Bytes content;

    memcpy(&content, bytes, sizeof content);
    if (is(me, "slow, crashes elsewhere") && content.process != getpid()) {
        abort();
    }
    if (is(me, "slow, refuses elsewhere") && content.process != getpid()) {
        return 3;
    }
    fmi2GetFMUstate(me, state);
    memcpy(((Model *)*state)->values, content.values, sizeof content.values);
    if (is(me, "slow, differs elsewhere") && content.process != getpid()) {
        ((Model *)*state)->values[GAIN] += 1e-9;
    }
    return 0;
}

int fmi2FreeFMUstate(Model *me, void **state) {
    free(*state);
    *state = NULL;
    return 0;
}
