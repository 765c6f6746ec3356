/* FMI 1.0 for co-simulation, stand-alone: no FMU state, no way to tell Terminated from Discard. */

#include <stdio.h>
#include <stdlib.h>

#include "fmi/common.h"
#include "fmi/fmi.h"
#include "fmi/log.h"

typedef struct {
    void (*logger)(void *component, const char *name, int status, const char *category,
                   const char *format, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*step_finished)(void *component, int status);
} Callbacks;

typedef struct {
    Older older;
    void *(*instantiate)(const char *name, const char *token, const char *location,
                         const char *mime_type, double timeout, char visible, char interactive,
                         Callbacks callbacks, char logging);
    int (*initialize)(void *component, double start_time, char has_stop_time, double stop_time);
    int (*do_step)(void *component, double time, double step, char new_step);
} Functions;

static const Binding bindings[] = {
    {"InstantiateSlave", offsetof(Functions, instantiate), true},
    {"FreeSlaveInstance", offsetof(Functions, older.common.free_instance), true},
    {"InitializeSlave", offsetof(Functions, initialize), true},
    {"DoStep", offsetof(Functions, do_step), true},
    {"TerminateSlave", offsetof(Functions, older.common.terminate), false},
    {"ResetSlave", offsetof(Functions, older.common.reset), false},
    BINDINGS_OF_VALUES_1,
    {"SetString", offsetof(Functions, older.set_string), false},
};

static bool bind(Library *library, char *error, size_t size) {
    char prefix[256];
    snprintf(prefix, sizeof prefix, "%s_fmi", library->identifier);
    return library_bind(library, prefix, bindings, COUNT_OF(bindings), sizeof(Functions),
                        error, size);
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
    .get = older_get,
    .set = older_set,
    .set_string = older_set_string,
    SHARED_FUNCTIONS,
};
