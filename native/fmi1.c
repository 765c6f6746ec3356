/* FMI 1.0 for co-simulation, stand-alone: no FMU state, no way to tell Terminated from Discard. */

#include <stdio.h>
#include <stdlib.h>

#include "fmi.h"
#include "log.h"

typedef struct {
    void (*logger)(void *component, const char *name, int status, const char *category,
                   const char *format, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*step_finished)(void *component, int status);
} Callbacks;

typedef struct {
    void *(*instantiate)(const char *name, const char *token, const char *location,
                         const char *mime_type, double timeout, char visible, char interactive,
                         Callbacks callbacks, char logging);
    void (*free_instance)(void *component);
    int (*initialize)(void *component, double start_time, char has_stop_time, double stop_time);
    int (*terminate)(void *component);
    int (*reset)(void *component);
    int (*do_step)(void *component, double time, double step, char new_step);
    int (*get_real)(void *component, const uint32_t *references, size_t count, double *values);
    int (*get_integer)(void *component, const uint32_t *references, size_t count, int *values);
    int (*get_boolean)(void *component, const uint32_t *references, size_t count, char *values);
    int (*set_real)(void *component, const uint32_t *references, size_t count,
                    const double *values);
    int (*set_integer)(void *component, const uint32_t *references, size_t count,
                       const int *values);
    int (*set_boolean)(void *component, const uint32_t *references, size_t count,
                       const char *values);
    int (*set_string)(void *component, const uint32_t *references, size_t count,
                      const char *const *values);
} Functions;

static const Binding bindings[] = {
    {"InstantiateSlave", offsetof(Functions, instantiate), true},
    {"FreeSlaveInstance", offsetof(Functions, free_instance), true},
    {"InitializeSlave", offsetof(Functions, initialize), true},
    {"DoStep", offsetof(Functions, do_step), true},
    {"TerminateSlave", offsetof(Functions, terminate), false},
    {"ResetSlave", offsetof(Functions, reset), false},
    {"GetReal", offsetof(Functions, get_real), false},
    {"GetInteger", offsetof(Functions, get_integer), false},
    {"GetBoolean", offsetof(Functions, get_boolean), false},
    {"SetReal", offsetof(Functions, set_real), false},
    {"SetInteger", offsetof(Functions, set_integer), false},
    {"SetBoolean", offsetof(Functions, set_boolean), false},
    {"SetString", offsetof(Functions, set_string), false},
};

static bool bind(Library *library, char *error, size_t size) {
    char prefix[256];
    snprintf(prefix, sizeof prefix, "%s_fmi", library->identifier);
    return library_bind(library, prefix, bindings, sizeof bindings / sizeof *bindings,
                        sizeof(Functions), error, size);
}

static const Functions *functions_of(const Library *library) {
    return library->functions;
}

static void *instantiate(const Library *library, const Identity *identity) {
    const Callbacks callbacks = {log_message_fmi1, calloc, free, NULL};
    return functions_of(library)->instantiate(identity->name, identity->token, identity->resources,
                                              "application/x-fmu-sharedlibrary", 0.0, 0, 0,
                                              callbacks, identity->logging);
}

static Status initialize(const Library *library, void *component, const Experiment *e,
                         StartValues start_values, const char **doing) {
    const Status status = start_values.set(start_values.context);

    *doing = "setting the start values";
    if (status > STATUS_WARNING) {
        return status;
    }
    *doing = "initialization";
    return sane(functions_of(library)->initialize(component, e->start_time, e->has_stop_time,
                                                  e->stop_time));
}

static Status do_step(const Library *library, void *component, double time, double step,
                      bool no_return) {
    (void)no_return;
    return sane(functions_of(library)->do_step(component, time, step, 1));
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

static bool exchange(const Library *library, const Exchange *e) {
    return exchange_by(&fmi1, library, e);
}

const Fmi fmi1 = {
    .boolean_size = sizeof(char),
    .bind = bind,
    .instantiate = instantiate,
    .initialize = initialize,
    .do_step = do_step,
    .exchange = exchange,
    .get = get,
    .set = set,
    .set_string = set_string,
    .reset = reset,
    .terminate = terminate,
    .free_instance = free_instance,
};
