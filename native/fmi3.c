/* FMI 3.0 for co-simulation, without event mode, early return and intermediate update. */

#include <stdlib.h>

#include "fmi.h"
#include "log.h"

typedef int Access3(void *instance, const uint32_t *references, size_t number_of_references,
                    void *values, size_t number_of_values);
typedef int ConstAccess3(void *instance, const uint32_t *references, size_t number_of_references,
                         const void *values, size_t number_of_values);

typedef struct {
    void *(*instantiate)(const char *name, const char *token, const char *resources, bool visible,
                         bool logging, bool event_mode_used, bool early_return_allowed,
                         const uint32_t *intermediate_variables, size_t number_of_variables,
                         void *environment,
                         void (*logger)(void *environment, int status, const char *category,
                                        const char *text),
                         void (*intermediate_update)(void));
    int (*set_debug_logging)(void *instance, bool on, size_t count, const char *const *categories);
    void (*free_instance)(void *instance);
    int (*enter_initialization)(void *instance, bool has_tolerance, double tolerance,
                                double start_time, bool has_stop_time, double stop_time);
    int (*exit_initialization)(void *instance);
    int (*terminate)(void *instance);
    int (*reset)(void *instance);
    int (*do_step)(void *instance, double time, double step, bool no_set_state,
                   bool *event_handling_needed, bool *terminate, bool *early_return,
                   double *last_successful_time);
    Access3 *get[NUMBER_OF_TYPES];
    ConstAccess3 *set[NUMBER_OF_TYPES];
    int (*set_string)(void *instance, const uint32_t *references, size_t number_of_references,
                      const char *const *values, size_t number_of_values);
    int (*get_state)(void *instance, void **state);
    int (*set_state)(void *instance, void *state);
    int (*free_state)(void *instance, void **state);
    int (*state_size)(void *instance, void *state, size_t *size);
    int (*serialize)(void *instance, void *state, char *bytes, size_t size);
    int (*deserialize)(void *instance, const char *bytes, size_t size, void **state);
} Functions;

#define ACCESS(name, type)                                                                         \
    {"Get" name, offsetof(Functions, get) + type * sizeof(Access3 *), false},                      \
        {"Set" name, offsetof(Functions, set) + type * sizeof(ConstAccess3 *), false}

static const Binding bindings[] = {
    {"InstantiateCoSimulation", offsetof(Functions, instantiate), true},
    {"SetDebugLogging", offsetof(Functions, set_debug_logging), false},
    {"FreeInstance", offsetof(Functions, free_instance), true},
    {"EnterInitializationMode", offsetof(Functions, enter_initialization), true},
    {"ExitInitializationMode", offsetof(Functions, exit_initialization), true},
    {"DoStep", offsetof(Functions, do_step), true},
    {"Terminate", offsetof(Functions, terminate), false},
    {"Reset", offsetof(Functions, reset), false},
    ACCESS("Float64", TYPE_FLOAT64),
    ACCESS("Float32", TYPE_FLOAT32),
    ACCESS("Int8", TYPE_INT8),
    ACCESS("Int16", TYPE_INT16),
    ACCESS("Int32", TYPE_INT32),
    ACCESS("Int64", TYPE_INT64),
    ACCESS("UInt8", TYPE_UINT8),
    ACCESS("UInt16", TYPE_UINT16),
    ACCESS("UInt32", TYPE_UINT32),
    ACCESS("UInt64", TYPE_UINT64),
    ACCESS("Boolean", TYPE_BOOLEAN),
    {"SetString", offsetof(Functions, set_string), false},
    {"GetFMUState", offsetof(Functions, get_state), false},
    {"SetFMUState", offsetof(Functions, set_state), false},
    {"FreeFMUState", offsetof(Functions, free_state), false},
    {"SerializedFMUStateSize", offsetof(Functions, state_size), false},
    {"SerializeFMUState", offsetof(Functions, serialize), false},
    {"DeserializeFMUState", offsetof(Functions, deserialize), false},
};

static bool bind(Library *library, char *error, size_t size) {
    return library_bind(library, "fmi3", bindings, sizeof bindings / sizeof *bindings,
                        sizeof(Functions), error, size);
}

static const Functions *functions_of(const Library *library) {
    return library->functions;
}

static void *instantiate(const Library *library, const Identity *identity) {
    return functions_of(library)->instantiate(
        identity->name, identity->token, identity->resources, false, identity->logging, false,
        false, NULL, 0, (void *)(uintptr_t)identity->environment, log_message_fmi3, NULL);
}

static Status choose_messages(const Library *library, void *instance,
                              const char *const *categories, size_t count) {
    const Functions *f = functions_of(library);
    return f->set_debug_logging == NULL
               ? STATUS_OK
               : sane(f->set_debug_logging(instance, count > 0, count, categories));
}

static Status initialize(const Library *library, void *instance, const Experiment *e,
                         StartValues start_values, const char **doing) {
    const Functions *f = functions_of(library);

    *doing = "setting the start values";
    Status status = start_values.set(start_values.context);
    if (status <= STATUS_WARNING) {
        *doing = "entering initialization";
        status = sane(f->enter_initialization(instance, e->has_tolerance, e->tolerance,
                                              e->start_time, e->has_stop_time, e->stop_time));
    }
    if (status <= STATUS_WARNING) {
        *doing = "initialization";
        status = sane(f->exit_initialization(instance));
    }
    return status;
}

static Status do_step(const Library *library, void *instance, double time, double step,
                      bool no_return) {
    bool event_handling_needed = false, terminate = false, early_return = false;
    double last_successful_time = time;
    const Status status =
        sane(functions_of(library)->do_step(instance, time, step, no_return, &event_handling_needed,
                                            &terminate, &early_return, &last_successful_time));

    if (status <= STATUS_WARNING && terminate) {
        return STATUS_TERMINATED;
    }
    if (status <= STATUS_WARNING && early_return) { /* early return was not allowed */
        return STATUS_DISCARD;
    }
    return status;
}

static Status get(const Library *library, void *instance, Type type, const uint32_t *references,
                  size_t count, void *values) {
    Access3 *function = functions_of(library)->get[type];
    if (function == NULL) {
        return STATUS_ERROR;
    }
    return sane(function(instance, references, count, values, count));
}

static Status set(const Library *library, void *instance, Type type, const uint32_t *references,
                  size_t count, const void *values) {
    ConstAccess3 *function = functions_of(library)->set[type];
    if (function == NULL) {
        return STATUS_ERROR;
    }
    return sane(function(instance, references, count, values, count));
}

static Status set_string(const Library *library, void *instance, uint32_t reference,
                         const char *text) {
    const Functions *f = functions_of(library);
    if (f->set_string == NULL) {
        return STATUS_ERROR;
    }
    return sane(f->set_string(instance, &reference, 1, &text, 1));
}

static Status reset(const Library *library, void *instance) {
    const Functions *f = functions_of(library);
    return f->reset == NULL ? STATUS_ERROR : sane(f->reset(instance));
}

static Status terminate(const Library *library, void *instance) {
    const Functions *f = functions_of(library);
    return f->terminate == NULL ? STATUS_OK : sane(f->terminate(instance));
}

static void free_instance(const Library *library, void *instance) {
    functions_of(library)->free_instance(instance);
}

static Status get_state(const Library *library, void *instance, void **state) {
    const Functions *f = functions_of(library);
    return f->get_state == NULL ? STATUS_ERROR : sane(f->get_state(instance, state));
}

static Status set_state(const Library *library, void *instance, void *state) {
    const Functions *f = functions_of(library);
    return f->set_state == NULL ? STATUS_ERROR : sane(f->set_state(instance, state));
}

static Status free_state(const Library *library, void *instance, void **state) {
    const Functions *f = functions_of(library);
    return f->free_state == NULL ? STATUS_OK : sane(f->free_state(instance, state));
}

static size_t state_size(const Library *library, void *instance, void *state) {
    const Functions *f = functions_of(library);
    size_t size = 0;
    if (f->state_size == NULL) {
        return 0;
    }
    return sane(f->state_size(instance, state, &size)) <= STATUS_WARNING ? size : 0;
}

static Status serialize(const Library *library, void *instance, void *state, char *bytes,
                        size_t size) {
    const Functions *f = functions_of(library);
    return f->serialize == NULL ? STATUS_ERROR
                                : sane(f->serialize(instance, state, bytes, size));
}

static Status deserialize(const Library *library, void *instance, const char *bytes, size_t size,
                          void **state) {
    const Functions *f = functions_of(library);
    return f->deserialize == NULL ? STATUS_ERROR
                                  : sane(f->deserialize(instance, bytes, size, state));
}

static bool exchange(const Library *library, const Exchange *e) {
    return exchange_by(&fmi3, library, e);
}

const Fmi fmi3 = {
    .boolean_size = sizeof(bool),
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
