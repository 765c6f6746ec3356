/* An FMU that knows which calls the standard allows when, and notes those that it does not.

   FMI_VERSION is 1, 2 or 3. y' = k u, read with each step. Steps longer than "longest" are discarded,
   if that is positive. A reset leaks as many bytes as "leak" says, and a step as many as "step_leak":
   until the instance is freed, or for ever if that is negative. What is noted, and which call returns what, is in the file that the
   environment variable LAWFUL_RECORD names, if any; see lawful_tools.py. Instances are never really
   freed, so that calls of freed ones can be told. Functions that nobody should call are generated in
   lawful_tools.py, too. */

#include <fcntl.h>
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

enum { U, Y, K, LONGEST, LEAK, STEP_LEAK, VARIABLES };
enum call { INSTANTIATE, SETUP, ENTER, EXIT, SET, STEP, GET, RESET, GET_STATE, SET_STATE, FREE_STATE,
            TERMINATE, GET_STATUS, FREE, CALLS };
enum { OK, WARNING, DISCARD, ERROR, FATAL, NOT_A_NUMBER, STOP };

/* The states of the standards' state machines, as bits. */
enum {
    INSTANTIATED = 1,
    SET_UP = 2,       /* FMI 2.0, after fmi2SetupExperiment */
    INITIALIZING = 4,
    STEPPING = 8,     /* stepComplete, Step Mode */
    STEP_FAILED = 16, /* FMI 1.0 and 2.0: after Discard */
    STOPPED = 32,     /* FMI 3.0: after the FMU's wish to stop */
    TERMINATED = 64,
    BROKEN = 128,     /* after Error */
    DEAD = 256        /* after Fatal */
};

typedef struct {
    int illegal, instances, states, unused;
    struct {
        int countdown, code;
    } plan[16];
    char first[128]; /* illegal call */
} Record;

typedef struct {
    double values[VARIABLES], time;
} Model;

typedef struct {
    Model model;
    double promised; /* the time before which no state will be restored */
    int state;
    bool alive, asked_to_stop;
    struct Leaked *leaked;
} Lawful;

typedef struct Leaked {
    struct Leaked *next;
} Leaked;

typedef struct {
    Model model;
    const Lawful *owner;
    int state;
    bool alive;
} Saved;

static const char *const names[] = {"instantiate", "setup", "enter", "exit", "set", "step", "get",
                                    "reset", "get_state", "set_state", "free_state", "terminate",
                                    "get_status", "free"};
static Record *record;
static Record unrecorded;

static void open_record(void) {
    if (record == NULL && getenv("LAWFUL_RECORD") == NULL) {
        record = &unrecorded;
    }
    if (record == NULL) {
        const int file = open(getenv("LAWFUL_RECORD"), O_RDWR);
        record = mmap(NULL, sizeof *record, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
        close(file);
    }
}

static void accuse(const char *call, const char *why, int state) {
    open_record();
    if (record->illegal++ == 0) {
        snprintf(record->first, sizeof record->first, "%s: %s, in state %d", call, why, state);
    }
}

static int planned(enum call call) {
    const int countdown = record->plan[call].countdown;
    record->plan[call].countdown -= countdown > 0;
    return countdown == 1 ? record->plan[call].code : OK;
}

static int judge(Lawful *me, int status) {
    if (status == ERROR) {
        me->state = BROKEN;
    } else if (status == FATAL) {
        me->state = DEAD;
    }
    return status;
}

static int require(Lawful *me, enum call call, int states) {
    if (!me->alive) {
        accuse(names[call], "the instance was freed", me->state);
        return ERROR;
    }
    if (!(me->state & states)) {
        accuse(names[call], "not allowed", me->state);
        return judge(me, ERROR);
    }
    return judge(me, planned(call));
}

static int go_on(Lawful *me, enum call call, int from, int to) {
    const int status = require(me, call, from);
    if (status <= WARNING) {
        me->state = to;
    }
    return status;
}

static Lawful *create(void) {
    open_record();
    if (planned(INSTANTIATE) != OK) {
        return NULL;
    }
    Lawful *me = calloc(1, sizeof *me);
    me->state = INSTANTIATED;
    me->alive = true;
    me->promised = -INFINITY;
    me->model.values[K] = 1;
    record->instances++;
    return me;
}

static void release(Lawful *me) {
    if (require(me, FREE, DEAD - 1) == OK) {
        me->alive = false;
        record->instances--;
    }
    for (Leaked *next; me->leaked != NULL; me->leaked = next) {
        next = me->leaked->next;
        free(me->leaked);
    }
}

static void leak(Lawful *me, double bytes) {
    if (bytes != 0) {
        const size_t size = sizeof(Leaked) + (size_t)fabs(bytes);
        Leaked *leaked = memset(malloc(size), 1, size);
        leaked->next = me->leaked;
        me->leaked = bytes > 0 ? leaked : me->leaked;
    }
}

static int reset(Lawful *me) {
    const int status = go_on(me, RESET, DEAD - 1, INSTANTIATED);
    leak(me, me->model.values[LEAK]);
    if (status <= WARNING) {
        me->model = (Model){.values = {0, 0, 1}};
        me->promised = -INFINITY;
    }
    return status;
}

static int set(Lawful *me, const unsigned *references, size_t count, const double *values) {
    const int before = INSTANTIATED | SET_UP | INITIALIZING;
    const int status = require(me, SET, before | STEPPING);
    for (size_t i = 0; i < count && status <= WARNING; i++) {
        if (references[i] == Y || (references[i] >= K && !(me->state & before))) {
            accuse("set", "a variable that may not be set now", me->state);
        }
        me->model.values[references[i]] = values[i];
    }
    return status;
}

static int get(Lawful *me, const unsigned *references, size_t count, double *values) {
    const int debugging = FMI_VERSION == 2 ? BROKEN : 0;
    const int states = INITIALIZING | STEPPING | STEP_FAILED | STOPPED | TERMINATED | debugging;
    const int status = require(me, GET, states);
    for (size_t i = 0; i < count; i++) {
        values[i] = status == NOT_A_NUMBER ? NAN : me->model.values[references[i]];
    }
    return status == NOT_A_NUMBER ? OK : status;
}

static void check_step(const Lawful *me, double time, double step) {
    if (!(fabs(time - me->model.time) < 1e-9)) {
        accuse("step", "not at the communication point", me->state);
    }
    if (!(step > 0) || !isfinite(step) || !isfinite(me->model.values[U])) {
        accuse("step", "not finite", me->state);
    }
}

/* stop is set where the FMU asks for the end. */
static int do_step(Lawful *me, double time, double step, bool no_return, bool *stop) {
    int status = require(me, STEP, STEPPING);
    leak(me, me->model.values[STEP_LEAK]);
    *stop = me->asked_to_stop = status == STOP;
    if (status <= WARNING && step > me->model.values[LONGEST] && me->model.values[LONGEST] > 0) {
        status = DISCARD;
    }
    if (me->state == STEPPING) {
        check_step(me, time, step);
        me->promised = no_return ? time : me->promised;
    }
    if (status <= WARNING || *stop) {
        me->model.values[Y] += step * me->model.values[K] * me->model.values[U];
        me->model.time = time + step;
    }
    if (*stop) {
        status = FMI_VERSION == 3 ? OK : DISCARD;
        me->state = FMI_VERSION == 3 ? STOPPED : STEP_FAILED;
    } else if (status == DISCARD && FMI_VERSION < 3) {
        me->state = STEP_FAILED;
    }
    return status;
}

static int initialize(Lawful *me, double start) {
    me->model.time = start;
    return go_on(me, ENTER, FMI_VERSION == 2 ? SET_UP : INSTANTIATED, INITIALIZING);
}

static int terminate(Lawful *me) {
    return go_on(me, TERMINATE, STEPPING | STEP_FAILED | STOPPED, TERMINATED);
}

#define UNUSED __attribute__((unused))

UNUSED static int get_state(Lawful *me, Saved **state) {
    const int broken = FMI_VERSION == 2 ? BROKEN : 0;
    const int status = require(me, GET_STATE, (BROKEN - 1) | broken);
    if (status <= WARNING) {
        *state = calloc(1, sizeof **state);
        **state = (Saved){me->model, me, me->state, true};
        record->states++;
    }
    return status;
}

static bool is_own(const Lawful *me, const Saved *state, enum call call) {
    const bool sound = state != NULL && state->alive && state->owner == me;
    if (!sound) {
        accuse(names[call], "a foreign or freed state", me->state);
    }
    return sound;
}

UNUSED static int set_state(Lawful *me, Saved *state) {
    const int status = require(me, SET_STATE, DEAD - 1);
    if (status > WARNING || !is_own(me, state, SET_STATE)) {
        return status;
    }
    if (state->model.time < me->promised - 1e-9) {
        accuse("set_state", "before a time that was promised", me->state);
    }
    me->model = state->model;
    me->state = state->state;
    return status;
}

UNUSED static int free_state(Lawful *me, Saved **state) {
    const int status = require(me, FREE_STATE, DEAD - 1);
    if (me->alive && *state != NULL && is_own(me, *state, FREE_STATE)) {
        (*state)->alive = false;
        *state = NULL;
        record->states--;
    }
    return status;
}

#if FMI_VERSION == 1

typedef struct {
    void *logger, *allocate, *release, *finished;
} Callbacks;

void *Lawful_fmiInstantiateSlave(const char *name, const char *token, const char *location,
                                 const char *type, double timeout, char visible, char interactive,
                                 Callbacks callbacks, char logging) {
    return create();
}

void Lawful_fmiFreeSlaveInstance(Lawful *me) {
    release(me);
}

int Lawful_fmiInitializeSlave(Lawful *me, double start, char stop_defined, double stop) {
    const int status = initialize(me, start);
    return status <= WARNING ? go_on(me, EXIT, INITIALIZING, STEPPING) : status;
}

int Lawful_fmiTerminateSlave(Lawful *me) {
    return terminate(me);
}

int Lawful_fmiResetSlave(Lawful *me) {
    return reset(me);
}

int Lawful_fmiDoStep(Lawful *me, double time, double step, char new_step) {
    bool stop;
    return do_step(me, time, step, true, &stop);
}

int Lawful_fmiGetReal(Lawful *me, const unsigned *references, size_t count, double *values) {
    return get(me, references, count, values);
}

int Lawful_fmiSetReal(Lawful *me, const unsigned *references, size_t count, const double *values) {
    return set(me, references, count, values);
}

#elif FMI_VERSION == 2

void *fmi2Instantiate(const char *name, int type, const char *token, const char *location,
                      const void *callbacks, int visible, int logging) {
    return create();
}

void fmi2FreeInstance(Lawful *me) {
    release(me);
}

int fmi2SetupExperiment(Lawful *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    return go_on(me, SETUP, INSTANTIATED, SET_UP);
}

int fmi2EnterInitializationMode(Lawful *me) {
    return initialize(me, 0);
}

int fmi2ExitInitializationMode(Lawful *me) {
    return go_on(me, EXIT, INITIALIZING, STEPPING);
}

int fmi2Terminate(Lawful *me) {
    return terminate(me);
}

int fmi2Reset(Lawful *me) {
    return reset(me);
}

int fmi2DoStep(Lawful *me, double time, double step, int no_return) {
    bool stop;
    return do_step(me, time, step, no_return, &stop);
}

int fmi2GetBooleanStatus(Lawful *me, int kind, int *value) {
    *value = me->asked_to_stop;
    return require(me, GET_STATUS, STEPPING | STEP_FAILED | TERMINATED);
}

int fmi2GetRealStatus(Lawful *me, int kind, double *value) {
    *value = me->model.time;
    return require(me, GET_STATUS, STEPPING | STEP_FAILED | TERMINATED);
}

int fmi2GetReal(Lawful *me, const unsigned *references, size_t count, double *values) {
    return get(me, references, count, values);
}

int fmi2SetReal(Lawful *me, const unsigned *references, size_t count, const double *values) {
    return set(me, references, count, values);
}

int fmi2GetFMUstate(Lawful *me, Saved **state) {
    return get_state(me, state);
}

int fmi2SetFMUstate(Lawful *me, Saved *state) {
    return set_state(me, state);
}

int fmi2FreeFMUstate(Lawful *me, Saved **state) {
    return free_state(me, state);
}

int fmi2SerializedFMUstateSize(Lawful *me, Saved *state, size_t *size) {
    *size = sizeof *state;
    return is_own(me, state, GET_STATE) ? OK : ERROR;
}

#else

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                  bool visible, bool logging, bool event_mode, bool early_return,
                                  const unsigned *intermediate, size_t intermediate_count,
                                  void *environment, void *logger, void *intermediate_update) {
    return create();
}

void fmi3FreeInstance(Lawful *me) {
    release(me);
}

int fmi3EnterInitializationMode(Lawful *me, bool tolerance_defined, double tolerance, double start,
                                bool stop_defined, double stop) {
    return initialize(me, start);
}

int fmi3ExitInitializationMode(Lawful *me) {
    return go_on(me, EXIT, INITIALIZING, STEPPING);
}

int fmi3Terminate(Lawful *me) {
    return terminate(me);
}

int fmi3Reset(Lawful *me) {
    return reset(me);
}

int fmi3DoStep(Lawful *me, double time, double step, bool no_return, bool *events, bool *stop,
               bool *early, double *last) {
    *events = *early = false;
    *last = time;
    return do_step(me, time, step, no_return, stop);
}

int fmi3GetFloat64(Lawful *me, const unsigned *references, size_t count, double *values,
                   size_t values_count) {
    return get(me, references, count, values);
}

int fmi3SetFloat64(Lawful *me, const unsigned *references, size_t count, const double *values,
                   size_t values_count) {
    return set(me, references, count, values);
}

int fmi3GetFMUState(Lawful *me, Saved **state) {
    return get_state(me, state);
}

int fmi3SetFMUState(Lawful *me, Saved *state) {
    return set_state(me, state);
}

int fmi3FreeFMUState(Lawful *me, Saved **state) {
    return free_state(me, state);
}

int fmi3SerializedFMUStateSize(Lawful *me, Saved *state, size_t *size) {
    *size = sizeof *state;
    return is_own(me, state, GET_STATE) ? OK : ERROR;
}

#endif

/* Nobody should call these. */
#define STUB(name)                                                                                 \
    int name(void) {                                                                               \
        accuse(#name, "not wanted", 0);                                                            \
        return ERROR;                                                                              \
    }
#include STUBS
