/* An FMU of FMI 1.0, 2.0 and 3.0 that fails and says why only if it is asked to: what it does is in
   its token, as words in any order.

   "refuse", "initialize", "set", "step", "discard", "get": the call that fails.
   "mute": it logs nothing, whatever it is asked. "loud": it logs without being asked.
   "chatty": it takes no notice of the categories, and logs each step when it is asked for any.
   "deaf": it cannot bear to be asked, and all later calls fail. "strict": it knows no category.
   "prints", "unflushed": lines on its standard output before it fails, the last without an end.
   "crash", "hang": how the step fails. "control": the messages have control characters.
   "long": ten lines, and the cause is in the last but one.
   Reals: 0 "u" (input), 1 "y" (output), 2 "at" (parameter: the step that fails; 0 for none),
   3 "asked" (output: how often it was asked). */

#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { OK, DISCARD = 2, ERROR = 3 };
enum { U, Y, AT, ASKED, VALUES };

#if FMI_VERSION == 3
typedef void (*Logger)(void *, int, const char *, const char *);
#else
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
#endif

typedef struct {
    double values[VALUES];
    int steps;
    bool all, errors, wrecked;
    Logger logger;
    void *environment;
    char name[200], token[100];
} Model;

static bool is(const Model *me, const char *word) {
    return strstr(me->token, word) != NULL;
}

static void say(const Model *me, int status, const char *category, const char *text) {
#if FMI_VERSION == 3
    me->logger(me->environment, status, category, text);
#else
    me->logger(me->environment, me->name, status, category, "%s", text);
#endif
}

static void say_ten_lines(const Model *me) {
    char line[60];
    for (int i = 1; i <= 8; i++) {
        snprintf(line, sizeof line, "timestep %d of the day is done", i);
        say(me, OK, "logAll", line);
    }
    say(me, OK, "logAll", "** Severe ** the node has no flow");
    say(me, OK, "logAll", "the run time was 0 h 0 min");
}

static int fail(const Model *me, int status, const char *call) {
    char text[200];

    snprintf(text, sizeof text, "%s because of %s%s", "Exception: the valve is stuck", call,
             is(me, "control") ? " \x1b[31m\x07" : "");
    if (is(me, "prints")) {
        printf("the solver gives up\nCPU time: 3 s\n");
        fprintf(stderr, "the oil is cold\n");
    }
    if (is(me, "unflushed")) {
        printf("no end");
    }
    if (!is(me, "mute") && (me->all || me->errors || is(me, "loud"))) {
        if (is(me, "long")) {
            say_ten_lines(me);
        } else {
            say(me, status, status == DISCARD ? "logStatusDiscard" : "logStatusError", text);
        }
    }
    return status;
}

static int call(const Model *me, const char *name) {
    return me->wrecked || is(me, name) ? fail(me, ERROR, name) : OK;
}

static void *instantiate(const char *name, const char *token, Logger logger, void *environment,
                         bool logging) {
    Model *me = calloc(1, sizeof *me);

    snprintf(me->name, sizeof me->name, "%s", name);
    snprintf(me->token, sizeof me->token, "%s", token);
    me->logger = logger;
    me->environment = environment;
    me->all = logging;
    if (call(me, "refuse") != OK) {
        free(me);
        return NULL;
    }
    return me;
}

static int ask(Model *me, bool on, size_t count, const char *const *categories) {
    me->values[ASKED]++;
    me->errors = false;
    if (is(me, "chatty")) {
        me->all = on;
    } else {
        me->all = on && count == 0;
        for (size_t i = 0; i < count; i++) {
            me->errors |= on && strcmp(categories[i], "logStatusError") == 0;
        }
    }
    me->wrecked = is(me, "deaf");
    return is(me, "deaf") || (is(me, "strict") && count > 0) ? ERROR : OK;
}

static int reset(Model *me) {
    memset(me->values, 0, sizeof(double) * ASKED);
    me->steps = 0;
    return OK;
}

static int step(Model *me, double step_size) {
    me->steps++;
    if (me->all && !is(me, "mute")) {
        say(me, OK, "logAll", "a step");
    }
    if (me->steps == (int)me->values[AT]) {
        if (is(me, "crash") || is(me, "hang")) {
            fail(me, ERROR, "step");
            fflush(stderr);
            raise(is(me, "hang") ? SIGSTOP : SIGSEGV);
        }
        if (is(me, "discard")) {
            return fail(me, DISCARD, "discard");
        }
        return call(me, "step");
    }
    me->values[Y] += step_size * me->values[U];
    return me->wrecked ? ERROR : OK;
}

static int set(Model *me, const uint32_t *references, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        me->values[references[i]] = values[i];
        if (references[i] == U && me->steps + 1 == (int)me->values[AT]) {
            return call(me, "set");
        }
    }
    return OK;
}

static int get(const Model *me, const uint32_t *references, size_t count, double *values) {
    for (size_t i = 0; i < count; i++) {
        values[i] = me->values[references[i]];
    }
    return me->steps > 0 && me->steps == (int)me->values[AT] ? call(me, "get") : OK;
}

#if FMI_VERSION == 1

typedef struct {
    Logger logger;
    void *allocate, *release, *finished;
} Callbacks;

void *Words_fmiInstantiateSlave(const char *name, const char *token, const char *location,
                                const char *type, double timeout, char visible, char interactive,
                                Callbacks callbacks, char logging) {
    return instantiate(name, token, callbacks.logger, NULL, logging);
}

void Words_fmiFreeSlaveInstance(Model *me) {
    free(me);
}

int Words_fmiSetDebugLogging(Model *me, char on) {
    return ask(me, on, 0, NULL);
}

int Words_fmiInitializeSlave(Model *me, double start, char stop_defined, double stop) {
    return call(me, "initialize");
}

int Words_fmiTerminateSlave(Model *me) {
    return OK;
}

int Words_fmiResetSlave(Model *me) {
    return reset(me);
}

int Words_fmiDoStep(Model *me, double time, double step_size, char new_step) {
    return step(me, step_size);
}

int Words_fmiGetReal(Model *me, const uint32_t *references, size_t count, double *values) {
    return get(me, references, count, values);
}

int Words_fmiSetReal(Model *me, const uint32_t *references, size_t count, const double *values) {
    return set(me, references, count, values);
}

const char *Words_fmiGetVersion(void) {
    return "1.0";
}

const char *Words_fmiGetTypesPlatform(void) {
    return "standard32";
}

#elif FMI_VERSION == 2

typedef struct {
    Logger logger;
    void *allocate, *release, *finished, *environment;
} Callbacks;

void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                      const Callbacks *callbacks, int visible, int logging) {
    return instantiate(name, token, callbacks->logger, callbacks->environment, logging);
}

void fmi2FreeInstance(Model *me) {
    free(me);
}

int fmi2SetDebugLogging(Model *me, int on, size_t count, const char *const *categories) {
    return ask(me, on, count, categories);
}

int fmi2SetupExperiment(Model *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    return OK;
}

int fmi2EnterInitializationMode(Model *me) {
    return OK;
}

int fmi2ExitInitializationMode(Model *me) {
    return call(me, "initialize");
}

int fmi2Terminate(Model *me) {
    return OK;
}

int fmi2Reset(Model *me) {
    return reset(me);
}

int fmi2DoStep(Model *me, double time, double step_size, int no_set_state) {
    return step(me, step_size);
}

int fmi2GetBooleanStatus(Model *me, int kind, int *value) {
    *value = 0;
    return OK;
}

int fmi2GetReal(Model *me, const uint32_t *references, size_t count, double *values) {
    return get(me, references, count, values);
}

int fmi2SetReal(Model *me, const uint32_t *references, size_t count, const double *values) {
    return set(me, references, count, values);
}

const char *fmi2GetVersion(void) {
    return "2.0";
}

const char *fmi2GetTypesPlatform(void) {
    return "default";
}

#else

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                  bool visible, bool logging, bool event_mode, bool early_return,
                                  const uint32_t *intermediate, size_t intermediate_count,
                                  void *environment, Logger logger, void *intermediate_update) {
    return instantiate(name, token, logger, environment, logging);
}

void fmi3FreeInstance(Model *me) {
    free(me);
}

int fmi3SetDebugLogging(Model *me, bool on, size_t count, const char *const *categories) {
    return ask(me, on, count, categories);
}

int fmi3EnterInitializationMode(Model *me, bool tolerance_defined, double tolerance, double start,
                                bool stop_defined, double stop) {
    return OK;
}

int fmi3ExitInitializationMode(Model *me) {
    return call(me, "initialize");
}

int fmi3Terminate(Model *me) {
    return OK;
}

int fmi3Reset(Model *me) {
    return reset(me);
}

int fmi3DoStep(Model *me, double time, double step_size, bool no_set_state, bool *events,
               bool *stop, bool *early, double *last) {
    *events = *stop = *early = false;
    *last = time + step_size;
    return step(me, step_size);
}

int fmi3GetFloat64(Model *me, const uint32_t *references, size_t count, double *values,
                   size_t values_count) {
    return get(me, references, count, values);
}

int fmi3SetFloat64(Model *me, const uint32_t *references, size_t count, const double *values,
                   size_t values_count) {
    return set(me, references, count, values);
}

const char *fmi3GetVersion(void) {
    return "3.0";
}

#endif

#include STUBS
