/* The functions of FMI 2.0, for the source files of both interfaces. */

#ifndef FMUGYM_FMI2_H
#define FMUGYM_FMI2_H

#include <stdlib.h>

#include "fmi/common.h"
#include "fmi/exchange.h"
#include "fmi/fmi.h"
#include "fmi/log.h"

typedef struct {
    void (*logger)(void *environment, const char *name, int status, const char *category,
                   const char *format, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*step_finished)(void *environment, int status);
    void *environment;
} Callbacks;

typedef struct {
    int needs_update;
    int terminate;
    int nominals_changed;
    int states_changed;
    int has_next_time;
    double next_time;
} EventInfo;

typedef struct {
    Older older;
    void *(*instantiate)(const char *name, int type, const char *token, const char *resources,
                         const Callbacks *callbacks, int visible, int logging);
    int (*set_debug_logging)(void *component, int on, size_t count, const char *const *categories);
    int (*set_up)(void *component, int has_tolerance, double tolerance, double start_time,
                  int has_stop_time, double stop_time);
    int (*enter_initialization)(void *component);
    int (*exit_initialization)(void *component);

    /* co-simulation */
    int (*do_step)(void *component, double time, double step, int no_set_state);
    int (*get_boolean_status)(void *component, int kind, int *value);
    int (*get_real_status)(void *component, int kind, double *value);

    /* model exchange */
    Equations equations;
    int (*update)(void *component, EventInfo *info);
    int (*complete)(void *component, int no_set_state, int *event, int *terminate);
    int (*differentiate)(void *component, const uint32_t *unknowns, size_t number_of_unknowns,
                         const uint32_t *knowns, size_t number_of_knowns, const double *seed,
                         double *sensitivity);
} Functions;

/* The bindings of functions that both interfaces have. */
#define SHARED_BINDINGS                                                                            \
    {"Instantiate", offsetof(Functions, instantiate), true},                                       \
    {"SetDebugLogging", offsetof(Functions, set_debug_logging), false},                            \
    {"FreeInstance", offsetof(Functions, older.common.free_instance), true},                       \
    {"SetupExperiment", offsetof(Functions, set_up), true},                                        \
    {"EnterInitializationMode", offsetof(Functions, enter_initialization), true},                  \
    {"ExitInitializationMode", offsetof(Functions, exit_initialization), true},                    \
    {"Terminate", offsetof(Functions, older.common.terminate), false},                             \
    {"Reset", offsetof(Functions, older.common.reset), false},                                     \
    ELEMENT("GetReal", Functions, older.get, TYPE_FLOAT64),                                        \
    ELEMENT("GetInteger", Functions, older.get, TYPE_INT32),                                       \
    ELEMENT("GetBoolean", Functions, older.get, TYPE_BOOLEAN),                                     \
    ELEMENT("SetReal", Functions, older.set, TYPE_FLOAT64),                                        \
    ELEMENT("SetInteger", Functions, older.set, TYPE_INT32),                                       \
    ELEMENT("SetBoolean", Functions, older.set, TYPE_BOOLEAN),                                     \
    {"SetString", offsetof(Functions, older.set_string), false},                                   \
    {"GetFMUstate", offsetof(Functions, older.common.get_state), false},                           \
    {"SetFMUstate", offsetof(Functions, older.common.set_state), false},                           \
    {"FreeFMUstate", offsetof(Functions, older.common.free_state), false},                         \
    {"SerializedFMUstateSize", offsetof(Functions, older.common.state_size), false},               \
    {"SerializeFMUstate", offsetof(Functions, older.common.serialize), false},                     \
    {"DeSerializeFMUstate", offsetof(Functions, older.common.deserialize), false},                 \
    {"GetDirectionalDerivative", offsetof(Functions, differentiate), false}

/* FMUs keep the pointer, so it must stay valid as long as any instance exists. */
static const Callbacks callbacks = {log_message_fmi2, calloc, free, NULL, NULL};

static inline const Functions *functions_of(const Library *library) {
    return library->functions;
}

static inline void *instantiate_as(int type, const Library *library, const Identity *identity) {
    return functions_of(library)->instantiate(identity->name, type, identity->token,
                                              identity->resources, &callbacks, 0,
                                              identity->logging);
}

static inline Status choose_messages(const Library *library, void *component,
                                     const char *const *categories, size_t count) {
    const Functions *f = functions_of(library);
    return f->set_debug_logging == NULL
               ? STATUS_OK
               : sane(f->set_debug_logging(component, count > 0, count, categories));
}

static inline Status initialize(const Library *library, void *component,
                                const Experiment *e, StartValues start_values, const char **doing) {
    const Functions *f = functions_of(library);

    *doing = "setting up the experiment";
    Status status = sane(f->set_up(component, e->has_tolerance, e->tolerance, e->start_time,
                                   e->has_stop_time, e->stop_time));
    if (status <= STATUS_WARNING) {
        *doing = "setting the start values";
        status = start_values.set(start_values.context);
    }
    if (status <= STATUS_WARNING) {
        *doing = "entering initialization";
        status = sane(f->enter_initialization(component));
    }
    if (status <= STATUS_WARNING) {
        status = exchange_in(start_values);
    }
    if (status <= STATUS_WARNING) {
        *doing = "initialization";
        status = sane(f->exit_initialization(component));
    }
    return status;
}

static inline Status derive(const Library *library, void *component, const Derivation *d,
                            double *values) {
    const Functions *f = functions_of(library);
    return f->differentiate == NULL || d->adjoint
               ? STATUS_ERROR
               : sane(f->differentiate(component, d->unknowns, d->number_of_unknowns, d->knowns,
                                       d->number_of_knowns, d->seed, values));
}

#endif
