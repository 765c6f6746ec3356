/* FMI 2.0 for model exchange. */

#include "fmi/fmi2.h"
#include "model_exchange/solved.h"

enum { MODEL_EXCHANGE = 0 };

static const Binding bindings[] = {
    SHARED_BINDINGS,
    {"SetTime", offsetof(Functions, equations.set_time), true},
    {"SetContinuousStates", offsetof(Functions, equations.set_states), true},
    {"GetContinuousStates", offsetof(Functions, equations.get_states), true},
    {"GetDerivatives", offsetof(Functions, equations.get_rates), true},
    {"GetEventIndicators", offsetof(Functions, equations.get_indicators), true},
    {"GetNominalsOfContinuousStates", offsetof(Functions, equations.get_nominals), true},
    {"EnterEventMode", offsetof(Functions, equations.enter_events), true},
    {"NewDiscreteStates", offsetof(Functions, update), true},
    {"EnterContinuousTimeMode", offsetof(Functions, equations.enter_continuous), true},
    {"CompletedIntegratorStep", offsetof(Functions, complete), true},
};

static bool bind(Library *library, char *error, size_t size) {
    return library_bind(library, "fmi2", bindings, COUNT_OF(bindings), sizeof(Functions),
                        error, size);
}

static Status update(const Library *library, void *component, Events *events) {
    EventInfo info = {0};
    const Status status = sane(functions_of(library)->update(component, &info));

    *events = (Events){info.needs_update != 0, info.terminate != 0, info.has_next_time != 0,
                       info.next_time};
    return status;
}

static Status complete(const Library *library, void *component, bool *event, bool *terminate) {
    int wants_event = 0, wants_to_stop = 0;
    const Status status =
        sane(functions_of(library)->complete(component, 0, &wants_event, &wants_to_stop));

    *event = wants_event != 0;
    *terminate = wants_to_stop != 0;
    return status;
}

static Status differentiate(const Library *library, void *component, const uint32_t *rates,
                            size_t count, uint32_t state, double *column) {
    const Functions *f = functions_of(library);
    const double seed = 1.0;

    return f->differentiate == NULL
               ? STATUS_ERROR
               : sane(f->differentiate(component, rates, count, &state, 1, &seed, column));
}

/* The FMU itself, without a solver. */
static const Fmi fmu = {
    .boolean_size = sizeof(int),
    .choose_messages = choose_messages,
    .initialize = initialize,
    .get = older_get,
    .set = older_set,
    .set_string = older_set_string,
    .derive = derive,
    SHARED_FUNCTIONS,
    SHARED_STATES,
};

static const Model model = {
    .fmi = &fmu,
    .equations = offsetof(Functions, equations),
    .update = update,
    .complete = complete,
    .differentiate = differentiate,
};

static void *instantiate(const Library *library, const Identity *identity) {
    return solved_take(&model, library, identity,
                       instantiate_as(MODEL_EXCHANGE, library, identity));
}

static bool exchange(const Library *library, const Exchange *e) {
    return exchange_by(&exchange2, library, e);
}

const Fmi exchange2 = {
    .boolean_size = sizeof(int),
    .bind = bind,
    .instantiate = instantiate,
    .choose_messages = solved_choose_messages,
    .exchange = exchange,
    SOLVED_FUNCTIONS,
    SOLVED_STATES,
};
