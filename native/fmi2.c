/* FMI 2.0 for co-simulation. */

#include <stdlib.h>

#include "fmi.h"
#include "log.h"
#include "shared.h"

enum { CO_SIMULATION = 1, TERMINATED = 3 /* fmi2Terminated of fmi2StatusKind */ };

typedef struct {
    void (*logger)(void *environment, const char *name, int status, const char *category,
                   const char *format, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*step_finished)(void *environment, int status);
    void *environment;
} Callbacks;

typedef struct {
    Older older;
    void *(*instantiate)(const char *name, int type, const char *token, const char *resources,
                         const Callbacks *callbacks, int visible, int logging);
    int (*set_debug_logging)(void *component, int on, size_t count, const char *const *categories);
    int (*set_up)(void *component, int has_tolerance, double tolerance, double start_time,
                  int has_stop_time, double stop_time);
    int (*enter_initialization)(void *component);
    int (*exit_initialization)(void *component);
    int (*do_step)(void *component, double time, double step, int no_set_state);
    int (*get_boolean_status)(void *component, int kind, int *value);
} Functions;

static const Binding bindings[] = {
    {"Instantiate", offsetof(Functions, instantiate), true},
    {"SetDebugLogging", offsetof(Functions, set_debug_logging), false},
    {"FreeInstance", offsetof(Functions, older.common.free_instance), true},
    {"SetupExperiment", offsetof(Functions, set_up), true},
    {"EnterInitializationMode", offsetof(Functions, enter_initialization), true},
    {"ExitInitializationMode", offsetof(Functions, exit_initialization), true},
    {"DoStep", offsetof(Functions, do_step), true},
    {"Terminate", offsetof(Functions, older.common.terminate), false},
    {"Reset", offsetof(Functions, older.common.reset), false},
    {"GetBooleanStatus", offsetof(Functions, get_boolean_status), false},
    ELEMENT("GetReal", Functions, older.get, TYPE_FLOAT64),
    ELEMENT("GetInteger", Functions, older.get, TYPE_INT32),
    ELEMENT("GetBoolean", Functions, older.get, TYPE_BOOLEAN),
    ELEMENT("SetReal", Functions, older.set, TYPE_FLOAT64),
    ELEMENT("SetInteger", Functions, older.set, TYPE_INT32),
    ELEMENT("SetBoolean", Functions, older.set, TYPE_BOOLEAN),
    {"SetString", offsetof(Functions, older.set_string), false},
    {"GetFMUstate", offsetof(Functions, older.common.get_state), false},
    {"SetFMUstate", offsetof(Functions, older.common.set_state), false},
    {"FreeFMUstate", offsetof(Functions, older.common.free_state), false},
    {"SerializedFMUstateSize", offsetof(Functions, older.common.state_size), false},
    {"SerializeFMUstate", offsetof(Functions, older.common.serialize), false},
    {"DeSerializeFMUstate", offsetof(Functions, older.common.deserialize), false},
};

/* FMUs keep the pointer, so it must stay valid as long as any instance exists. */
static const Callbacks callbacks = {log_message_fmi2, calloc, free, NULL, NULL};

static bool bind(Library *library, char *error, size_t size) {
    return library_bind(library, "fmi2", bindings, COUNT_OF(bindings), sizeof(Functions),
                        error, size);
}

static const Functions *functions_of(const Library *library) {
    return library->functions;
}

static void *instantiate(const Library *library, const Identity *identity) {
    return functions_of(library)->instantiate(identity->name, CO_SIMULATION, identity->token,
                                              identity->resources, &callbacks, 0,
                                              identity->logging);
}

static Status choose_messages(const Library *library, void *component,
                              const char *const *categories, size_t count) {
    const Functions *f = functions_of(library);
    return f->set_debug_logging == NULL
               ? STATUS_OK
               : sane(f->set_debug_logging(component, count > 0, count, categories));
}

static Status initialize(const Library *library, void *component, const Experiment *e,
                         StartValues start_values, const char **doing) {
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
        *doing = "initialization";
        status = sane(f->exit_initialization(component));
    }
    return status;
}

/* Finds out what a discarded step means. An FMU that cannot report the reason counts as
 * discarding. */
static Status judge_discard(const Functions *f, void *component) {
    int terminated = 0;

    if (f->get_boolean_status == NULL) {
        return STATUS_DISCARD;
    }
    const Status status = sane(f->get_boolean_status(component, TERMINATED, &terminated));
    if (status == STATUS_FATAL) {
        return status;
    }
    return status <= STATUS_WARNING && terminated != 0 ? STATUS_TERMINATED : STATUS_DISCARD;
}

static Status do_step(const Library *library, void *component, double time, double step,
                      bool no_return) {
    const Functions *f = functions_of(library);
    const Status status = sane(f->do_step(component, time, step, no_return));
    return status == STATUS_DISCARD ? judge_discard(f, component) : status;
}

static bool exchange(const Library *library, const Exchange *e) {
    return exchange_by(&fmi2, library, e);
}

const Fmi fmi2 = {
    .boolean_size = sizeof(int),
    .bind = bind,
    .instantiate = instantiate,
    .choose_messages = choose_messages,
    .initialize = initialize,
    .do_step = do_step,
    .exchange = exchange,
    .get = older_get,
    .set = older_set,
    .set_string = older_set_string,
    .reset = reset,
    .terminate = terminate,
    .free_instance = free_instance,
    .get_state = get_state,
    .set_state = set_state,
    .free_state = free_state,
    .state_size = state_size,
    .serialize = serialize,
    .deserialize = deserialize,
};
