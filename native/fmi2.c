/* FMI 2.0 for co-simulation. */

#include <stdlib.h>

#include "fmi.h"
#include "log.h"

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
    void *(*instantiate)(const char *name, int type, const char *token, const char *resources,
                         const Callbacks *callbacks, int visible, int logging);
    int (*set_debug_logging)(void *component, int on, size_t count, const char *const *categories);
    void (*free_instance)(void *component);
    int (*set_up)(void *component, int has_tolerance, double tolerance, double start_time,
                  int has_stop_time, double stop_time);
    int (*enter_initialization)(void *component);
    int (*exit_initialization)(void *component);
    int (*terminate)(void *component);
    int (*reset)(void *component);
    int (*do_step)(void *component, double time, double step, int no_set_state);
    int (*get_boolean_status)(void *component, int kind, int *value);
    int (*get_real)(void *component, const uint32_t *references, size_t count, double *values);
    int (*get_integer)(void *component, const uint32_t *references, size_t count, int *values);
    int (*get_boolean)(void *component, const uint32_t *references, size_t count, int *values);
    int (*set_real)(void *component, const uint32_t *references, size_t count,
                    const double *values);
    int (*set_integer)(void *component, const uint32_t *references, size_t count,
                       const int *values);
    int (*set_boolean)(void *component, const uint32_t *references, size_t count,
                       const int *values);
    int (*set_string)(void *component, const uint32_t *references, size_t count,
                      const char *const *values);
    int (*get_state)(void *component, void **state);
    int (*set_state)(void *component, void *state);
    int (*free_state)(void *component, void **state);
    int (*state_size)(void *component, void *state, size_t *size);
    int (*serialize)(void *component, void *state, char *bytes, size_t size);
    int (*deserialize)(void *component, const char *bytes, size_t size, void **state);
} Functions;

static const Binding bindings[] = {
    {"Instantiate", offsetof(Functions, instantiate), true},
    {"SetDebugLogging", offsetof(Functions, set_debug_logging), false},
    {"FreeInstance", offsetof(Functions, free_instance), true},
    {"SetupExperiment", offsetof(Functions, set_up), true},
    {"EnterInitializationMode", offsetof(Functions, enter_initialization), true},
    {"ExitInitializationMode", offsetof(Functions, exit_initialization), true},
    {"DoStep", offsetof(Functions, do_step), true},
    {"Terminate", offsetof(Functions, terminate), false},
    {"Reset", offsetof(Functions, reset), false},
    {"GetBooleanStatus", offsetof(Functions, get_boolean_status), false},
    {"GetReal", offsetof(Functions, get_real), false},
    {"GetInteger", offsetof(Functions, get_integer), false},
    {"GetBoolean", offsetof(Functions, get_boolean), false},
    {"SetReal", offsetof(Functions, set_real), false},
    {"SetInteger", offsetof(Functions, set_integer), false},
    {"SetBoolean", offsetof(Functions, set_boolean), false},
    {"SetString", offsetof(Functions, set_string), false},
    {"GetFMUstate", offsetof(Functions, get_state), false},
    {"SetFMUstate", offsetof(Functions, set_state), false},
    {"FreeFMUstate", offsetof(Functions, free_state), false},
    {"SerializedFMUstateSize", offsetof(Functions, state_size), false},
    {"SerializeFMUstate", offsetof(Functions, serialize), false},
    {"DeSerializeFMUstate", offsetof(Functions, deserialize), false},
};

/* FMUs keep the pointer, so it must stay valid as long as any instance exists. */
static const Callbacks callbacks = {log_message_fmi2, calloc, free, NULL, NULL};

static bool bind(Library *library, char *error, size_t size) {
    return library_bind(library, "fmi2", bindings, sizeof bindings / sizeof *bindings,
                        sizeof(Functions), error, size);
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

static Status get(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, void *values) {
    const Functions *f = functions_of(library);

    if (type == TYPE_FLOAT64 && f->get_real != NULL) {
        return sane(f->get_real(component, references, count, values));
    }
    if (type == TYPE_INT32 && f->get_integer != NULL) {
        return sane(f->get_integer(component, references, count, values));
    }
    if (type == TYPE_BOOLEAN && f->get_boolean != NULL) {
        return sane(f->get_boolean(component, references, count, values));
    }
    return STATUS_ERROR;
}

static Status set(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, const void *values) {
    const Functions *f = functions_of(library);

    if (type == TYPE_FLOAT64 && f->set_real != NULL) {
        return sane(f->set_real(component, references, count, values));
    }
    if (type == TYPE_INT32 && f->set_integer != NULL) {
        return sane(f->set_integer(component, references, count, values));
    }
    if (type == TYPE_BOOLEAN && f->set_boolean != NULL) {
        return sane(f->set_boolean(component, references, count, values));
    }
    return STATUS_ERROR;
}

static Status set_string(const Library *library, void *component, uint32_t reference,
                         const char *text) {
    const Functions *f = functions_of(library);
    if (f->set_string == NULL) {
        return STATUS_ERROR;
    }
    return sane(f->set_string(component, &reference, 1, &text));
}

static Status reset(const Library *library, void *component) {
    const Functions *f = functions_of(library);
    return f->reset == NULL ? STATUS_ERROR : sane(f->reset(component));
}

static Status terminate(const Library *library, void *component) {
    const Functions *f = functions_of(library);
    return f->terminate == NULL ? STATUS_OK : sane(f->terminate(component));
}

static void free_instance(const Library *library, void *component) {
    functions_of(library)->free_instance(component);
}

static Status get_state(const Library *library, void *component, void **state) {
    const Functions *f = functions_of(library);
    return f->get_state == NULL ? STATUS_ERROR : sane(f->get_state(component, state));
}

static Status set_state(const Library *library, void *component, void *state) {
    const Functions *f = functions_of(library);
    return f->set_state == NULL ? STATUS_ERROR : sane(f->set_state(component, state));
}

static Status free_state(const Library *library, void *component, void **state) {
    const Functions *f = functions_of(library);
    return f->free_state == NULL ? STATUS_OK : sane(f->free_state(component, state));
}

static size_t state_size(const Library *library, void *component, void *state) {
    const Functions *f = functions_of(library);
    size_t size = 0;
    if (f->state_size == NULL) {
        return 0;
    }
    return sane(f->state_size(component, state, &size)) <= STATUS_WARNING ? size : 0;
}

static Status serialize(const Library *library, void *component, void *state, char *bytes,
                        size_t size) {
    const Functions *f = functions_of(library);
    return f->serialize == NULL ? STATUS_ERROR
                                : sane(f->serialize(component, state, bytes, size));
}

static Status deserialize(const Library *library, void *component, const char *bytes, size_t size,
                          void **state) {
    const Functions *f = functions_of(library);
    return f->deserialize == NULL ? STATUS_ERROR
                                  : sane(f->deserialize(component, bytes, size, state));
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
    .get = get,
    .set = set,
    .set_string = set_string,
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
