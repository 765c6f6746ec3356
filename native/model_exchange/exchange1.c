/* FMI 1.0 for model exchange: no modes, no FMU state, and no reset. */

#include <stdio.h>
#include <stdlib.h>

#include "fmi/common.h"
#include "fmi/fmi.h"
#include "fmi/log.h"
#include "model_exchange/solved.h"

/* One less than in co-simulation. */
typedef struct {
    void (*logger)(void *component, const char *name, int status, const char *category,
                   const char *format, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
} Callbacks;

typedef struct {
    char converged;
    char state_references_changed;
    char states_changed;
    char terminate;
    char has_next_time;
    double next_time;
} EventInfo;

typedef struct {
    Older older;
    Equations equations;
    void *(*instantiate)(const char *name, const char *token, Callbacks callbacks, char logging);
    int (*initialize)(void *component, char has_tolerance, double tolerance, EventInfo *info);
    int (*update)(void *component, char intermediate_results, EventInfo *info);
    int (*complete)(void *component, char *event);
} Functions;

static const Binding bindings[] = {
    {"InstantiateModel", offsetof(Functions, instantiate), true},
    {"FreeModelInstance", offsetof(Functions, older.common.free_instance), true},
    {"Initialize", offsetof(Functions, initialize), true},
    {"Terminate", offsetof(Functions, older.common.terminate), false},
    {"SetTime", offsetof(Functions, equations.set_time), true},
    {"SetContinuousStates", offsetof(Functions, equations.set_states), true},
    {"GetContinuousStates", offsetof(Functions, equations.get_states), true},
    {"GetDerivatives", offsetof(Functions, equations.get_rates), true},
    {"GetEventIndicators", offsetof(Functions, equations.get_indicators), true},
    {"GetNominalContinuousStates", offsetof(Functions, equations.get_nominals), true},
    {"EventUpdate", offsetof(Functions, update), true},
    {"CompletedIntegratorStep", offsetof(Functions, complete), true},
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

/* An FMU may leave as it is what has not changed, and fill the rest at events only. */
static EventInfo info_before(const Events *events) {
    return (EventInfo){
        .converged = 1, .has_next_time = events->has_next, .next_time = events->next};
}

static void take_info(const EventInfo *info, Events *events) {
    *events = (Events){info->converged == 0, info->terminate != 0, info->has_next_time != 0,
                       info->next_time};
}

static Status initialize(const Library *library, void *component, const Experiment *e,
                         StartValues start_values, const char **doing, Events *events) {
    const Functions *f = functions_of(library);
    EventInfo info = info_before(events);

    *doing = "setting the start values";
    Status status = start_values.set(start_values.context);
    if (status <= STATUS_WARNING) {
        *doing = "initialization";
        status = sane(f->equations.set_time(component, e->start_time));
    }
    if (status <= STATUS_WARNING) {
        status = sane(f->initialize(component, e->has_tolerance, e->tolerance, &info));
    }
    take_info(&info, events);
    return status;
}

/* The FMU repeats the update by itself, since it need not tell intermediate results. */
static Status update(const Library *library, void *component, Events *events) {
    EventInfo info = info_before(events);
    const Status status = sane(functions_of(library)->update(component, 0, &info));

    take_info(&info, events);
    return status;
}

static Status complete(const Library *library, void *component, bool *event, bool *terminate) {
    char wants_event = 0;
    const Status status = sane(functions_of(library)->complete(component, &wants_event));

    *event = wants_event != 0;
    *terminate = false;
    return status;
}

/* The FMU itself, without a solver. */
static const Fmi fmu = {
    .boolean_size = sizeof(char),
    .get = older_get,
    .set = older_set,
    .set_string = older_set_string,
    SHARED_FUNCTIONS,
};

static const Model model = {
    .fmi = &fmu,
    .equations = offsetof(Functions, equations),
    .update = update,
    .initialize = initialize,
    .complete = complete,
};

static void *instantiate(const Library *library, const Identity *identity) {
    const Callbacks callbacks = {log_message_fmi1, calloc, free};
    return solved_take(&model, library, identity,
                       functions_of(library)->instantiate(identity->name, identity->token,
                                                          callbacks, identity->logging));
}

static bool exchange(const Library *library, const Exchange *e) {
    return exchange_by(&exchange1, library, e);
}

const Fmi exchange1 = {
    .boolean_size = sizeof(char),
    .bind = bind,
    .instantiate = instantiate,
    .exchange = exchange,
    SOLVED_FUNCTIONS,
};
