/* FMUs that do wrong what they are told to.

   y' = u, read with each step. The parameters say what happens ("fault"), in which call ("call"),
   and after how many steps ("at"); "status" is what STATUS returns. Parameters come too late for
   some faults, which the instantiation token asks for: see zoo_instantiate. */

#define _GNU_SOURCE
#include "zoo.h"

#include <fenv.h>
#include <limits.h>
#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#if defined __x86_64__
#include <xmmintrin.h>
#endif

enum { LEAKED_BYTES = 4 << 20, PAGE = 4096, LINES = 20000, MESSAGES = 200, DESCRIPTORS = 200,
       SECONDS = 30 };

enum variable { U, Y, FAULT, CALL, AT, STATUS_CODE, VARIABLES };

enum fault {
    NONE,
    SEGV,
    FPE,
    ILL,
    BUS,
    ABORT,
    LEAVE,
    OVERFLOW,
    LOOP,
    SLEEP,
    CLOSE_STANDARD,
    CLOSE_OTHERS,
    STATUS,
    NOT_A_NUMBER,
    INFINITE,
    PRINT,
    PRINT_NO_NEWLINE,
    PRINT_MUCH,
    LOG_FROM_THREAD,
    ROUND_UP,
    FLUSH_DENORMALS,
    CHANGE_DIRECTORY,
    CHANGE_ENVIRONMENT,
    LEAK,
    DO_NOTHING,
    FORK,
    FORK_AND_CRASH,
    FORK_AND_LOOP,
    FORK_A_TWIN
};

struct Animal {
    double values[VARIABLES];
    int steps;
    bool stepping, shares, talking;
    char name[128];
    Logger logger;
    void *environment;
    pthread_t talker;
};

/* What instances of one library share. */
static int instances;
static double shared_y;

#if defined CRASH_IN_CONSTRUCTOR
__attribute__((constructor)) static void crash(void) {
    raise(SIGSEGV);
}
#endif

static void say(Animal *me, const char *text) {
#if FMI_VERSION == 3
    me->logger(me->environment, WARNING, "zoo", text);
#else
    me->logger(me->environment, me->name, WARNING, "zoo", "%s", text);
#endif
}

static void *talk(void *argument) {
    for (int i = 0; i < MESSAGES; i++) {
        say(argument, "hello from another thread");
    }
    return NULL;
}

static void start_talking(Animal *me) {
    if (!me->talking) {
        me->talking = pthread_create(&me->talker, NULL, talk, me) == 0;
    }
}

static void stop_talking(Animal *me) {
    if (me->talking) {
        pthread_join(me->talker, NULL);
        me->talking = false;
    }
}

/* Each call needs a frame of its own: what it returns is used after the call. */
static int overflow(int depth) {
    volatile char frame[4096];
    memset((char *)frame, depth, sizeof frame);
    return depth == INT_MAX ? 0 : overflow(depth + 1) + frame[depth % 4096];
}

static void write_to_null(void) {
    volatile int *volatile nowhere = NULL;
    *nowhere = 1;
}

static void hang(bool sleeping) {
    const struct timespec hour = {3600, 0};
    for (volatile bool hanging = true; hanging;) {
        if (sleeping) {
            nanosleep(&hour, NULL);
        }
    }
}

static void close_descriptors(int first, int end) {
    for (int descriptor = first; descriptor < end; descriptor++) {
        close(descriptor);
    }
}

static void print(int lines, const char *text) {
    for (int i = 0; i < lines; i++) {
        fputs(text, stdout);
    }
    fflush(stdout);
}

static void leak(void) {
    volatile char *memory = malloc(LEAKED_BYTES);
    for (int i = 0; memory != NULL && i < LEAKED_BYTES; i += PAGE) {
        memory[i] = 1;
    }
}

/* The new process keeps open what this one has open. */
static void fork_sleeper(void) {
    if (fork() == 0) {
        sleep(SECONDS);
        _exit(0);
    }
}

/* Faults that end the process or never return. */
static void die(int fault) {
    switch (fault) {
    case FORK_AND_CRASH:
        fork_sleeper();
        write_to_null();
        break;
    case FORK_AND_LOOP:
        fork_sleeper();
        hang(false);
        break;
    case SEGV:
        write_to_null();
        break;
    case FPE:
        raise(SIGFPE);
        break;
    case ILL:
        raise(SIGILL);
        break;
    case BUS:
        raise(SIGBUS);
        break;
    case ABORT:
        abort();
    case LEAVE:
        exit(0);
    case OVERFLOW:
        overflow(0);
        break;
    case LOOP:
    case SLEEP:
        hang(fault == SLEEP);
        break;
    default:
        break;
    }
}

/* As code does that was compiled with -ffast-math, when its library is loaded. */
static void flush_denormals(void) {
#if defined __x86_64__
    _mm_setcsr(_mm_getcsr() | 0x8040);
#elif defined __aarch64__
    unsigned long control;
    __asm__ volatile("mrs %0, fpcr" : "=r"(control));
    __asm__ volatile("msr fpcr, %0" : : "r"(control | 1ul << 24));
#endif
}

/* Faults that the process survives; a call returns what this does. */
static int misbehave(Animal *me, int fault) {
    switch (fault) {
    case CLOSE_STANDARD:
        close_descriptors(0, 3);
        break;
    case CLOSE_OTHERS:
        close_descriptors(3, DESCRIPTORS);
        break;
    case STATUS:
        say(me, "this status was asked for");
        return (int)me->values[STATUS_CODE];
    case NOT_A_NUMBER:
        me->values[Y] = NAN;
        break;
    case INFINITE:
        me->values[Y] = INFINITY;
        break;
    case PRINT:
        print(1, "a line of the zoo\n");
        break;
    case PRINT_NO_NEWLINE:
        print(1, "no line of the zoo");
        break;
    case PRINT_MUCH:
        print(LINES, "one of many lines of the zoo\n");
        break;
    case LOG_FROM_THREAD:
        start_talking(me);
        break;
    case ROUND_UP:
        fesetround(FE_UPWARD);
        break;
    case FLUSH_DENORMALS:
        flush_denormals();
        break;
    case CHANGE_DIRECTORY:
        return chdir("/") == 0 ? OK : ERROR;
    case CHANGE_ENVIRONMENT:
        setenv("ZOO", "was here", 1);
        break;
    case LEAK:
        leak();
        break;
    case FORK:
        fork_sleeper();
        break;
    case FORK_A_TWIN:
        fork();
        break;
    default:
        break;
    }
    return OK;
}

static bool is_due(const Animal *me, enum call call) {
    return (int)me->values[CALL] == (int)call && me->steps >= (int)me->values[AT];
}

int zoo_call(Animal *me, enum call call) {
    if (!is_due(me, call)) {
        return OK;
    }
    die((int)me->values[FAULT]);
    return misbehave(me, (int)me->values[FAULT]);
}

static bool does_nothing(const Animal *me, enum call call) {
    return is_due(me, call) && (int)me->values[FAULT] == DO_NOTHING;
}

/* Returns the status of the instantiation, were there one. */
static int take_parameters(Animal *me, const char *token) {
    double *v = me->values;
    sscanf(token, "{zoo %lf %lf %lf}", &v[FAULT], &v[CALL], &v[STATUS_CODE]);
    return zoo_call(me, INSTANTIATE);
}

/* Tokens: "{zoo}"; "{zoo alone}" for one instance at a time; "{zoo share}" for y in a global
   variable; "{zoo FAULT CALL STATUS}" for a fault in a call before parameters are set. An
   instantiation with another status than OK gives NULL. */
Animal *zoo_instantiate(const Birth *birth) {
    const char *token = birth->token;
    Animal *me = calloc(1, sizeof *me);
    if (me == NULL) {
        return NULL;
    }
    snprintf(me->name, sizeof me->name, "%s", birth->name);
    me->logger = birth->logger;
    me->environment = FMI_VERSION == 1 ? me : birth->environment;
    me->shares = strcmp(token, "{zoo share}") == 0;
    const bool alone = strcmp(token, "{zoo alone}") == 0;
    if (take_parameters(me, token) != OK || (alone && instances > 0)) {
        say(me, "there is an instance already");
        free(me);
        return NULL;
    }
    instances++;
    return me;
}

void zoo_free(Animal *me) {
    zoo_call(me, FREE);
    stop_talking(me);
    instances--;
    free(me);
}

static bool is_fine(int status) {
    return status == OK || status == WARNING;
}

int zoo_enter(Animal *me) {
    const int status = zoo_call(me, SETUP);
    return is_fine(status) ? zoo_call(me, ENTER) : status;
}

int zoo_exit(Animal *me) {
    const int status = zoo_call(me, EXIT);
    me->stepping = is_fine(status);
    shared_y = me->values[Y];
    return status;
}

int zoo_initialize(Animal *me) {
    const int status = zoo_enter(me);
    return is_fine(status) ? zoo_exit(me) : status;
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    me->steps++;
    double *y = me->shares ? &shared_y : &me->values[Y];
    *y += step_size * me->values[U];
    me->values[Y] = *y;
    return zoo_call(me, STEP);
}

int zoo_get(Animal *me, const unsigned *references, size_t count, double *values) {
    zoo_read(me->values, references, count, values);
    return zoo_call(me, GET);
}

int zoo_set(Animal *me, const unsigned *references, size_t count, const double *values) {
    zoo_write(me->values, references, count, values);
    return me->stepping ? zoo_call(me, SET) : OK;
}

int zoo_reset(Animal *me) {
    const double y = does_nothing(me, RESET) ? me->values[Y] : 0;
    const int status = zoo_call(me, RESET);
    stop_talking(me);
    memset(me->values, 0, sizeof me->values);
    me->values[Y] = y;
    me->steps = 0;
    me->stepping = false;
    return status;
}

int zoo_get_state(Animal *me, void **state) {
    const int status = zoo_call(me, GET_STATE);
    *state = malloc(sizeof *me);
    memcpy(*state, me, sizeof *me);
    return status;
}

int zoo_set_state(Animal *me, void *state) {
    const int status = zoo_call(me, SET_STATE);
    if (!does_nothing(me, SET_STATE)) {
        stop_talking(me);
        memcpy(me, state, sizeof *me);
        me->talking = false;
    }
    return status;
}
