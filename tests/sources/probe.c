/* An FMU for tests that does as its parameters say; FMI_VERSION is 1, 2 or 3.

   A value reference is 100 times the type's number plus an index (fmu_tools.py has the table). All
   numbers are kept as doubles. The model: sum' = gain * a, mix = a + 10 b + 100 c + trim, and an
   output for each other input. */

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <math.h>

enum { REAL, INTEGER, BOOLEAN, ENUMERATION, STRING, FLOAT32, INT8, UINT16, INT64, TYPES };
enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING, STOP, NOT_A_NUMBER };
enum { BEFORE_SETUP, SET_UP, INITIALIZING, STEPPING, FAILED };

#define VR(type, index) (100 * (type) + (index))
#define V(type, index) (me->values[VR(type, index)])

/* Reals */
#define A V(REAL, 0)
#define B V(REAL, 1)
#define C V(REAL, 2)
#define FREE V(REAL, 3)
#define MIX V(REAL, 10)
#define SUM V(REAL, 11)
#define TIME V(REAL, 12)
#define STEP_SIZE V(REAL, 13)
#define FREE_OUT V(REAL, 14)
#define GAIN V(REAL, 20)
#define TRIM V(REAL, 21)
#define CONSTANT V(REAL, 22)
#define DOUBLE_GAIN V(REAL, 23)
#define STOP_TIME V(REAL, 24)
#define TOLERANCE V(REAL, 25)
/* Integers: n is 0, n_out is 10 */
#define STEPS V(INTEGER, 11)
#define INSTANCES V(INTEGER, 12)
#define LIVE_STATES V(INTEGER, 13)
#define ILLEGAL_CALLS V(INTEGER, 14)
#define FAULT V(INTEGER, 20)
#define FAULT_STEP V(INTEGER, 21)
#define INIT_STATUS V(INTEGER, 22)
#define RESET_STATUS V(INTEGER, 23)
#define RESTORE_STATUS V(INTEGER, 24)
#define SET_STATUS V(INTEGER, 25)
#define LOG_STATUS V(INTEGER, 26)
#define REFUSALS V(INTEGER, 27)
#define GET_STATUS V(INTEGER, 28)
/* Booleans: on is 0, on_out is 10 */
#define LEAKY V(BOOLEAN, 20)

typedef unsigned int Reference;

typedef struct {
    double values[100 * TYPES];
    char label[64];
    char name[128];
    int phase;
    bool logging;
    void *logger;
    void *environment;
} Probe;

/* What instances of one library share. */
static int instances, live_states, illegal_calls, refusals;

#if FMI_VERSION == 1
#define NAME(f) Probe_fmi##f
#define TOKEN "{probe-1}"
typedef char Bool;
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
    void *logger, *allocate, *release, *finished;
} Callbacks;
#elif FMI_VERSION == 2
#define NAME(f) fmi2##f
#define TOKEN "{probe-2}"
typedef int Bool;
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
    void *logger, *allocate, *release, *finished, *environment;
} Callbacks;
#else
#define NAME(f) fmi3##f
#define TOKEN "{probe-3}"
typedef bool Bool;
typedef void (*Logger)(void *, int, const char *, const char *);
#endif

static void say(Probe *me, int status, const char *category, int number) {
    Logger logger = (Logger)me->logger;
    if (logger == NULL || (status == OK && !me->logging)) {
        return;
    }
#if FMI_VERSION == 3
    char text[256];
    snprintf(text, sizeof text, "step %d of %s is 100%%", number, me->label);
    logger(me->environment, status, category, text);
#else
    logger(me->environment, me->name, status, category, "step %d of %s is 100%%", number,
           me->label);
#endif
}

static void start_values(Probe *me) {
    double leaked = LEAKY ? SUM : 0;
    memset(me->values, 0, sizeof me->values);
    GAIN = 1;
    CONSTANT = 7;
    LOG_STATUS = -1;
    V(ENUMERATION, 0) = V(ENUMERATION, 10) = 1;
    SUM = leaked;
    strcpy(me->label, "probe");
    me->phase = BEFORE_SETUP;
}

static void calculate(Probe *me) {
    MIX = A + 10 * B + 100 * C + TRIM;
    FREE_OUT = FREE;
    DOUBLE_GAIN = 2 * GAIN;
    for (int type = INTEGER; type < TYPES; type++) {
        if (type != STRING) {
            V(type, 10) = V(type, 0);
        }
    }
    INSTANCES = instances;
    LIVE_STATES = live_states;
    ILLEGAL_CALLS = illegal_calls;
}

static Probe *create(const char *name, const char *token, bool logging, void *logger,
                     void *environment) {
    if (refusals > 0) {
        refusals--;
        return NULL;
    }
    Probe *me = calloc(1, sizeof *me);
    snprintf(me->name, sizeof me->name, "%s", name);
    me->logging = logging;
    me->logger = logger;
    me->environment = environment;
    start_values(me);
    if (strcmp(token, TOKEN) != 0) {
        say(me, ERROR, "token", 0);
        free(me);
        return NULL;
    }
    instances++;
    return me;
}

static int fail(Probe *me, int status) {
    if (status >= ERROR) {
        me->phase = FAILED;
    }
    return status;
}

static int require(Probe *me, int phase) {
    if (me->phase != phase) {
        illegal_calls++;
        return fail(me, ERROR);
    }
    return OK;
}

static int set_up(Probe *me, double start, bool stop_defined, double stop, bool tolerance_defined,
                  double tolerance) {
    int status = require(me, BEFORE_SETUP);
    me->phase = status == OK ? SET_UP : me->phase;
#ifdef DEMANDS /* a condition under which it says DEMANDED */
    if (DEMANDS) {
#if FMI_VERSION == 3
        ((Logger)me->logger)(me->environment, ERROR, "error", DEMANDED);
#else
        ((Logger)me->logger)(me->environment, me->name, ERROR, "error", DEMANDED);
#endif
        status = ERROR;
    }
#endif
    TIME = start;
    STOP_TIME = stop_defined ? stop : -1;
    TOLERANCE = tolerance_defined ? tolerance : -1;
    return status;
}

static int enter(Probe *me) {
    int status = require(me, SET_UP);
    me->phase = status == OK ? INITIALIZING : me->phase;
    return status;
}

static int leave(Probe *me) {
    int status = require(me, INITIALIZING);
    refusals = (int)REFUSALS;
    calculate(me);
    if (status == OK && INIT_STATUS > WARNING) {
        say(me, (int)INIT_STATUS, "init", 0);
        return fail(me, (int)INIT_STATUS);
    }
    me->phase = status == OK ? STEPPING : me->phase;
    return status;
}

static int reset(Probe *me) {
    if (RESET_STATUS > WARNING) {
        return fail(me, (int)RESET_STATUS);
    }
    start_values(me);
    return OK;
}

static int terminate(Probe *me) {
    return require(me, STEPPING);
}

static int do_step(Probe *me, double time, double step_size, bool *stop) {
    int status = require(me, STEPPING);
    *stop = false;
    if (status != OK) {
        return status;
    }
    STEPS++;
    TIME = time + step_size;
    STEP_SIZE = step_size;
    SUM += step_size * GAIN * A;
    calculate(me);
    if (LOG_STATUS >= 0) {
        say(me, (int)LOG_STATUS, "probe", (int)STEPS);
    }
    if (STEPS != FAULT_STEP) {
        return OK;
    }
    if (FAULT == NOT_A_NUMBER) {
        SUM = NAN;
        return OK;
    }
    *stop = FAULT == STOP;
    return *stop ? OK : fail(me, (int)FAULT);
}

static int check(Probe *me, int type, const Reference *references, size_t count) {
    for (size_t i = 0; i < count; i++) {
        if (references[i] / 100 != (Reference)type) {
            illegal_calls++;
            return fail(me, ERROR);
        }
    }
    return OK;
}

static int status_of(Probe *me, int status) {
    return me->phase >= STEPPING && status > WARNING ? fail(me, status) : status;
}

/* FMI 1.0 and 2.0 set enumerations as integers. */
static int type_of(int type, const Reference *references, size_t count) {
    bool other = FMI_VERSION < 3 && count > 0 && references[0] / 100 == ENUMERATION;
    return type == INTEGER && other ? ENUMERATION : type;
}

#if FMI_VERSION == 3
#define COUNTED , size_t values_count
#else
#define COUNTED
#endif

/* One reference in a call may be an Integer and the next an Enumeration, so each is looked at. */
#define ACCESS(suffix, ctype, type)                                                                \
    int NAME(Get##suffix)(Probe *me, const Reference *vr, size_t count, ctype *value COUNTED) {    \
        for (size_t i = 0; i < count; i++) {                                                       \
            if (check(me, type_of(type, vr + i, 1), vr + i, 1) != OK) {                            \
                return ERROR;                                                                      \
            }                                                                                      \
            value[i] = (ctype)me->values[vr[i]];                                                   \
        }                                                                                          \
        return status_of(me, me->phase == STEPPING && STEPS > 0 ? (int)GET_STATUS : OK);           \
    }                                                                                              \
    int NAME(Set##suffix)(Probe *me, const Reference *vr, size_t count,                            \
                          const ctype *value COUNTED) {                                            \
        illegal_calls += me->phase == FAILED;                                                      \
        for (size_t i = 0; i < count; i++) {                                                       \
            if (check(me, type_of(type, vr + i, 1), vr + i, 1) != OK) {                            \
                return ERROR;                                                                      \
            }                                                                                      \
            me->values[vr[i]] = (double)value[i];                                                  \
        }                                                                                          \
        return me->phase == STEPPING ? status_of(me, (int)SET_STATUS) : OK;                        \
    }

#if FMI_VERSION == 3
ACCESS(Float64, double, REAL)
ACCESS(Int32, int32_t, INTEGER)
ACCESS(Boolean, bool, BOOLEAN)
ACCESS(Float32, float, FLOAT32)
ACCESS(Int8, int8_t, INT8)
ACCESS(UInt16, uint16_t, UINT16)

/* Int64 carries enumerations too. */
int fmi3GetInt64(Probe *me, const Reference *vr, size_t count, int64_t *value, size_t values) {
    for (size_t i = 0; i < count; i++) {
        value[i] = (int64_t)me->values[vr[i]];
    }
    return OK;
}

int fmi3SetInt64(Probe *me, const Reference *vr, size_t count, const int64_t *value,
                 size_t values) {
    for (size_t i = 0; i < count; i++) {
        me->values[vr[i]] = (double)value[i];
    }
    return OK;
}
#else
ACCESS(Real, double, REAL)
ACCESS(Integer, int, INTEGER)
ACCESS(Boolean, Bool, BOOLEAN)
#endif

int NAME(SetString)(Probe *me, const Reference *vr, size_t count, const char *const *value COUNTED) {
    if (count > 0) {
        snprintf(me->label, sizeof me->label, "%s", value[0]);
    }
    return check(me, STRING, vr, count);
}

#if FMI_VERSION >= 2
static int get_state(Probe *me, void **state) {
    *state = malloc(sizeof *me);
    memcpy(*state, me, sizeof *me);
    live_states++;
    return OK;
}

static int set_state(Probe *me, void *state) {
    int status = (int)RESTORE_STATUS;
    if (status > WARNING) {
        return fail(me, status);
    }
    memcpy(me, state, sizeof *me);
    return OK;
}

static int free_state(void **state) {
    live_states -= *state != NULL;
    free(*state);
    *state = NULL;
    return OK;
}
#endif

#define STUB(name)                                                                                 \
    int NAME(name)(void) {                                                                         \
        return ERROR;                                                                              \
    }

STUB(SetDebugLogging)
STUB(GetString)
const char *NAME(GetVersion)(void) {
    return FMI_VERSION == 1 ? "1.0" : FMI_VERSION == 2 ? "2.0" : "3.0";
}

#if FMI_VERSION == 1

void *Probe_fmiInstantiateSlave(const char *name, const char *token, const char *location,
                                const char *type, double timeout, char visible, char interactive,
                                Callbacks callbacks, char logging) {
    Probe *me = create(name, token, logging, callbacks.logger, NULL);
    if (me != NULL) {
        me->environment = me;
    }
    return me;
}

void Probe_fmiFreeSlaveInstance(Probe *me) {
    free(me);
}

int Probe_fmiInitializeSlave(Probe *me, double start, char stop_defined, double stop) {
    int status = set_up(me, start, stop_defined, stop, false, 0);
    status = status == OK ? enter(me) : status;
    return status == OK ? leave(me) : status;
}

int Probe_fmiTerminateSlave(Probe *me) {
    return terminate(me);
}

int Probe_fmiResetSlave(Probe *me) {
    return reset(me);
}

int Probe_fmiDoStep(Probe *me, double time, double step_size, char new_step) {
    bool stop;
    int status = do_step(me, time, step_size, &stop);
    return stop ? DISCARD : status;
}

STUB(GetTypesPlatform)
STUB(CancelStep)
STUB(GetStatus)
STUB(GetRealStatus)
STUB(GetIntegerStatus)
STUB(GetBooleanStatus)
STUB(GetStringStatus)
STUB(GetRealOutputDerivatives)
STUB(SetRealInputDerivatives)

#elif FMI_VERSION == 2

void *fmi2Instantiate(const char *name, int type, const char *token, const char *location,
                      const Callbacks *callbacks, int visible, int logging) {
    return create(name, token, logging, callbacks->logger, callbacks->environment);
}

void fmi2FreeInstance(Probe *me) {
    free(me);
}

int fmi2SetupExperiment(Probe *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    return set_up(me, start, stop_defined, stop, tolerance_defined, tolerance);
}

int fmi2EnterInitializationMode(Probe *me) {
    return enter(me);
}

int fmi2ExitInitializationMode(Probe *me) {
    return leave(me);
}

int fmi2Terminate(Probe *me) {
    return terminate(me);
}

int fmi2Reset(Probe *me) {
    return reset(me);
}

int fmi2DoStep(Probe *me, double time, double step_size, int no_set_state) {
    bool stop;
    int status = do_step(me, time, step_size, &stop);
    return stop ? DISCARD : status;
}

int fmi2GetBooleanStatus(Probe *me, int kind, int *value) {
    *value = kind == 3 && FAULT == STOP && STEPS == FAULT_STEP;
    return OK;
}

int fmi2GetFMUstate(Probe *me, void **state) {
    return get_state(me, state);
}

int fmi2SetFMUstate(Probe *me, void *state) {
    return set_state(me, state);
}

int fmi2FreeFMUstate(Probe *me, void **state) {
    return free_state(state);
}

STUB(GetTypesPlatform)
STUB(SerializedFMUstateSize)
STUB(SerializeFMUstate)
STUB(DeSerializeFMUstate)
STUB(GetDirectionalDerivative)
STUB(SetRealInputDerivatives)
STUB(GetRealOutputDerivatives)
STUB(CancelStep)
STUB(GetStatus)
STUB(GetRealStatus)
STUB(GetIntegerStatus)
STUB(GetStringStatus)

#else

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                  bool visible, bool logging, bool event_mode, bool early_return,
                                  const Reference *intermediate, size_t intermediate_count,
                                  void *environment, Logger logger, void *intermediate_update) {
    return create(name, token, logging, (void *)logger, environment);
}

void fmi3FreeInstance(Probe *me) {
    free(me);
}

int fmi3EnterInitializationMode(Probe *me, bool tolerance_defined, double tolerance, double start,
                                bool stop_defined, double stop) {
    int status = set_up(me, start, stop_defined, stop, tolerance_defined, tolerance);
    return status == OK ? enter(me) : status;
}

int fmi3ExitInitializationMode(Probe *me) {
    return leave(me);
}

int fmi3Terminate(Probe *me) {
    return terminate(me);
}

int fmi3Reset(Probe *me) {
    return reset(me);
}

int fmi3DoStep(Probe *me, double time, double step_size, bool no_set_state, bool *events,
               bool *stop, bool *early, double *last) {
    *events = *early = false;
    *last = time + step_size;
    return do_step(me, time, step_size, stop);
}

int fmi3GetFMUState(Probe *me, void **state) {
    return get_state(me, state);
}

int fmi3SetFMUState(Probe *me, void *state) {
    return set_state(me, state);
}

int fmi3FreeFMUState(Probe *me, void **state) {
    return free_state(state);
}

STUB(InstantiateModelExchange)
STUB(InstantiateScheduledExecution)
STUB(GetInt16)
STUB(GetUInt8)
STUB(GetUInt32)
STUB(GetUInt64)
STUB(GetBinary)
STUB(GetClock)
STUB(SetInt16)
STUB(SetUInt8)
STUB(SetUInt32)
STUB(SetUInt64)
STUB(SetBinary)
STUB(SetClock)
STUB(ActivateModelPartition)
STUB(CompletedIntegratorStep)
STUB(DeserializeFMUState)
STUB(EnterConfigurationMode)
STUB(EnterContinuousTimeMode)
STUB(EnterEventMode)
STUB(EnterStepMode)
STUB(EvaluateDiscreteStates)
STUB(ExitConfigurationMode)
STUB(GetAdjointDerivative)
STUB(GetContinuousStateDerivatives)
STUB(GetContinuousStates)
STUB(GetDirectionalDerivative)
STUB(GetEventIndicators)
STUB(GetIntervalDecimal)
STUB(GetIntervalFraction)
STUB(GetNominalsOfContinuousStates)
STUB(GetNumberOfContinuousStates)
STUB(GetNumberOfEventIndicators)
STUB(GetNumberOfVariableDependencies)
STUB(GetOutputDerivatives)
STUB(GetShiftDecimal)
STUB(GetShiftFraction)
STUB(GetVariableDependencies)
STUB(SerializeFMUState)
STUB(SerializedFMUStateSize)
STUB(SetContinuousStates)
STUB(SetIntervalDecimal)
STUB(SetIntervalFraction)
STUB(SetShiftDecimal)
STUB(SetShiftFraction)
STUB(SetTime)
STUB(UpdateDiscreteStates)

#endif
