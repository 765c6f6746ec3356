/* The functions of FMI 3.0, for the source files of both interfaces. */

#ifndef FMUGYM_FMI3_H
#define FMUGYM_FMI3_H

#include <stdlib.h>
#include <string.h>

#include "fmi/common.h"
#include "fmi/exchange.h"
#include "fmi/fmi.h"
#include "fmi/log.h"

typedef int Get3(void *instance, const uint32_t *references, size_t number_of_references,
                 void *values, size_t number_of_values);
typedef int Derive3(void *instance, const uint32_t *unknowns, size_t number_of_unknowns,
                    const uint32_t *knowns, size_t number_of_knowns, const double *seed,
                    size_t size_of_seed, double *values, size_t size_of_values);
typedef int Set3(void *instance, const uint32_t *references, size_t number_of_references,
                 const void *values, size_t number_of_values);

typedef void Logger3(void *environment, int status, const char *category, const char *text);

typedef void IntermediateUpdate3(void *environment, double time, bool set_requested,
                                 bool get_allowed, bool step_finished, bool can_return_early,
                                 bool *early_return_requested, double *early_return_time);

typedef struct {
    Common common;
    int (*set_debug_logging)(void *instance, bool on, size_t count, const char *const *categories);
    int (*enter_initialization)(void *instance, bool has_tolerance, double tolerance,
                                double start_time, bool has_stop_time, double stop_time);
    int (*exit_initialization)(void *instance);
    int (*enter_configuration)(void *instance);
    int (*exit_configuration)(void *instance);
    Get3 *get[NUMBER_OF_TYPES];
    Set3 *set[NUMBER_OF_TYPES];
    int (*set_string)(void *instance, const uint32_t *references, size_t number_of_references,
                      const char *const *values, size_t number_of_values);

    /* co-simulation */
    void *(*instantiate_steps)(const char *name, const char *token, const char *resources,
                               bool visible, bool logging, bool event_mode_used,
                               bool early_return_allowed, const uint32_t *intermediate_variables,
                               size_t number_of_variables, void *environment, Logger3 *logger,
                               IntermediateUpdate3 *intermediate_update);
    int (*do_step)(void *instance, double time, double step, bool no_set_state,
                   bool *event_handling_needed, bool *terminate, bool *early_return,
                   double *last_successful_time);

    /* model exchange */
    void *(*instantiate_equations)(const char *name, const char *token, const char *resources,
                                   bool visible, bool logging, void *environment, Logger3 *logger);
    Equations equations;
    int (*update)(void *instance, bool *needs_update, bool *terminate, bool *nominals_changed,
                  bool *states_changed, bool *has_next_time, double *next_time);
    int (*complete)(void *instance, bool no_set_state, bool *event, bool *terminate);
    ClockFunctions clocks;
    Derive3 *differentiate, *differentiate_adjoint;
} Functions;

#define VALUES(name, type)                                                                         \
    ELEMENT("Get" name, Functions, get, type), ELEMENT("Set" name, Functions, set, type)

/* The bindings of functions for events and clocks. */
#define BINDINGS_OF_EVENTS                                                                         \
    {"EnterEventMode", offsetof(Functions, equations.enter_events), true},                         \
    {"UpdateDiscreteStates", offsetof(Functions, update), true},                                   \
    {"GetClock", offsetof(Functions, clocks.get), false},                                          \
    {"SetClock", offsetof(Functions, clocks.set), false},                                          \
    {"GetIntervalDecimal", offsetof(Functions, clocks.get_interval), false},                       \
    {"GetShiftDecimal", offsetof(Functions, clocks.get_shift), false},                             \
    {"SetIntervalDecimal", offsetof(Functions, clocks.set_interval), false},                       \
    {"GetIntervalFraction", offsetof(Functions, clocks.get_interval_fraction), false},             \
    {"GetShiftFraction", offsetof(Functions, clocks.get_shift_fraction), false},                   \
    {"SetIntervalFraction", offsetof(Functions, clocks.set_interval_fraction), false}

/* The bindings of functions that both interfaces have. */
#define SHARED_BINDINGS                                                                            \
    {"SetDebugLogging", offsetof(Functions, set_debug_logging), false},                            \
    {"FreeInstance", offsetof(Functions, common.free_instance), true},                             \
    {"EnterInitializationMode", offsetof(Functions, enter_initialization), true},                  \
    {"ExitInitializationMode", offsetof(Functions, exit_initialization), true},                    \
    {"EnterConfigurationMode", offsetof(Functions, enter_configuration), false},                   \
    {"ExitConfigurationMode", offsetof(Functions, exit_configuration), false},                     \
    {"Terminate", offsetof(Functions, common.terminate), false},                                   \
    {"Reset", offsetof(Functions, common.reset), false},                                           \
    VALUES("Float64", TYPE_FLOAT64),                                                               \
    VALUES("Float32", TYPE_FLOAT32),                                                               \
    VALUES("Int8", TYPE_INT8),                                                                     \
    VALUES("Int16", TYPE_INT16),                                                                   \
    VALUES("Int32", TYPE_INT32),                                                                   \
    VALUES("Int64", TYPE_INT64),                                                                   \
    VALUES("UInt8", TYPE_UINT8),                                                                   \
    VALUES("UInt16", TYPE_UINT16),                                                                 \
    VALUES("UInt32", TYPE_UINT32),                                                                 \
    VALUES("UInt64", TYPE_UINT64),                                                                 \
    VALUES("Boolean", TYPE_BOOLEAN),                                                               \
    {"SetString", offsetof(Functions, set_string), false},                                         \
    {"GetFMUState", offsetof(Functions, common.get_state), false},                                 \
    {"SetFMUState", offsetof(Functions, common.set_state), false},                                 \
    {"FreeFMUState", offsetof(Functions, common.free_state), false},                               \
    {"SerializedFMUStateSize", offsetof(Functions, common.state_size), false},                     \
    {"SerializeFMUState", offsetof(Functions, common.serialize), false},                           \
    {"DeserializeFMUState", offsetof(Functions, common.deserialize), false},                       \
    {"GetDirectionalDerivative", offsetof(Functions, differentiate), false},                       \
    {"GetAdjointDerivative", offsetof(Functions, differentiate_adjoint), false}

static inline const Functions *functions_of(const Library *library) {
    return library->functions;
}

static inline void *as_environment(const Identity *identity) {
    return (void *)(uintptr_t)identity->environment;
}

static inline Status choose_messages(const Library *library, void *instance,
                                     const char *const *categories, size_t count) {
    const Functions *f = functions_of(library);
    return f->set_debug_logging == NULL
               ? STATUS_OK
               : sane(f->set_debug_logging(instance, count > 0, count, categories));
}

/* Sets structural parameters, by which arrays get their sizes. */
static inline Status configure(const Functions *f, void *instance, const Experiment *e) {
    Set3 *set = f->set[TYPE_UINT64];
    Status status = f->enter_configuration == NULL || f->exit_configuration == NULL || set == NULL
                        ? STATUS_ERROR
                        : sane(f->enter_configuration(instance));

    for (size_t i = 0; i < e->number_of_structural && status <= STATUS_WARNING; i++) {
        uint32_t reference;
        uint64_t value;
        memcpy(&reference, e->structural_references + i * sizeof reference, sizeof reference);
        memcpy(&value, e->structural_values + i * sizeof value, sizeof value);
        status = sane(set(instance, &reference, 1, &value, 1));
    }
    return status > STATUS_WARNING ? status : sane(f->exit_configuration(instance));
}

static inline Status initialize(const Library *library, void *instance,
                                const Experiment *e, StartValues start_values, const char **doing) {
    const Functions *f = functions_of(library);
    Status status = STATUS_OK;

    if (e->number_of_structural > 0) {
        *doing = "setting the structural parameters";
        status = configure(f, instance, e);
    }
    if (status <= STATUS_WARNING) {
        *doing = "setting the start values";
        status = start_values.set(start_values.context);
    }
    if (status <= STATUS_WARNING) {
        *doing = "entering initialization";
        status = sane(f->enter_initialization(instance, e->has_tolerance, e->tolerance,
                                              e->start_time, e->has_stop_time, e->stop_time));
    }
    if (status <= STATUS_WARNING && start_values.prepare != NULL) {
        *doing = "preparing the clocks";
        status = start_values.prepare(start_values.prepared);
    }
    if (status <= STATUS_WARNING) {
        status = exchange_in(start_values);
    }
    if (status <= STATUS_WARNING) {
        *doing = "initialization";
        status = sane(f->exit_initialization(instance));
    }
    return status;
}

static inline Status update3(const Library *library, void *instance, Events *events) {
    bool nominals_changed = false, states_changed = false;

    *events = (Events){0};
    return sane(functions_of(library)->update(instance, &events->again, &events->terminate,
                                              &nominals_changed, &states_changed,
                                              &events->has_next, &events->next));
}

/* FMUs may call it without asking whether it is there. Nobody wants an early return. */
static inline void ignore_intermediate_update(void *environment, double time, bool set_requested,
                                              bool get_allowed, bool step_finished,
                                              bool can_return_early, bool *early_return_requested,
                                              double *early_return_time) {
    (void)environment, (void)set_requested, (void)get_allowed, (void)step_finished;
    (void)can_return_early;
    if (early_return_requested != NULL) {
        *early_return_requested = false;
    }
    if (early_return_time != NULL) {
        *early_return_time = time;
    }
}

/* Nothing is wanted in intermediate updates, but FMUs may make them all the same. */
static inline void *instantiate_steps(const Library *library, const Identity *identity,
                                      bool with_events) {
    return functions_of(library)->instantiate_steps(
        identity->name, identity->token, identity->resources, false, identity->logging, with_events,
        with_events, NULL, 0, as_environment(identity), log_message_fmi3,
        ignore_intermediate_update);
}

static inline Status get3(const Library *library, void *instance, Type type,
                          const uint32_t *references, size_t count, void *values, size_t size) {
    Get3 *function = functions_of(library)->get[type];
    if (function == NULL) {
        return STATUS_ERROR;
    }
    return sane(function(instance, references, count, values, size));
}

static inline Status set3(const Library *library, void *instance, Type type,
                          const uint32_t *references, size_t count, const void *values,
                          size_t size) {
    Set3 *function = functions_of(library)->set[type];
    if (function == NULL) {
        return STATUS_ERROR;
    }
    return sane(function(instance, references, count, values, size));
}

static inline Status set_string3(const Library *library, void *instance, uint32_t reference,
                                 const char *text) {
    const Functions *f = functions_of(library);
    if (f->set_string == NULL) {
        return STATUS_ERROR;
    }
    return sane(f->set_string(instance, &reference, 1, &text, 1));
}

static inline Status derive(const Library *library, void *instance, const Derivation *d,
                            double *values) {
    const Functions *f = functions_of(library);
    Derive3 *function = d->adjoint ? f->differentiate_adjoint : f->differentiate;
    return function == NULL
               ? STATUS_ERROR
               : sane(function(instance, d->unknowns, d->number_of_unknowns, d->knowns,
                               d->number_of_knowns, d->seed, d->size_of_seed, values,
                               d->size_of_values));
}

#endif
