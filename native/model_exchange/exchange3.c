/* FMI 3.0 for model exchange. */

#include "fmi/fmi3.h"
#include "model_exchange/solved.h"

static const Binding bindings[] = {
    SHARED_BINDINGS,
    BINDINGS_OF_EVENTS,
    {"InstantiateModelExchange", offsetof(Functions, instantiate_equations), true},
    {"SetTime", offsetof(Functions, equations.set_time), true},
    {"SetContinuousStates", offsetof(Functions, equations.set_states), true},
    {"GetContinuousStates", offsetof(Functions, equations.get_states), true},
    {"GetContinuousStateDerivatives", offsetof(Functions, equations.get_rates), true},
    {"GetEventIndicators", offsetof(Functions, equations.get_indicators), true},
    {"GetNominalsOfContinuousStates", offsetof(Functions, equations.get_nominals), true},
    {"EnterContinuousTimeMode", offsetof(Functions, equations.enter_continuous), true},
    {"CompletedIntegratorStep", offsetof(Functions, complete), true},
};

static bool bind(Library *library, char *error, size_t size) {
    return library_bind(library, "fmi3", bindings, COUNT_OF(bindings), sizeof(Functions),
                        error, size);
}

static Status complete(const Library *library, void *instance, bool *event, bool *terminate) {
    return sane(functions_of(library)->complete(instance, false, event, terminate));
}

static Status differentiate(const Library *library, void *instance, const uint32_t *rates,
                            size_t count, uint32_t state, double *column) {
    const Functions *f = functions_of(library);
    const double seed = 1.0;

    return f->differentiate == NULL ? STATUS_ERROR
                                    : sane(f->differentiate(instance, rates, count, &state, 1,
                                                            &seed, 1, column, count));
}

/* The FMU itself, without a solver. */
static const Fmi fmu = {
    .boolean_size = sizeof(bool),
    .choose_messages = choose_messages,
    .initialize = initialize,
    .get = get3,
    .set = set3,
    .set_string = set_string3,
    .derive = derive,
    SHARED_FUNCTIONS,
    SHARED_STATES,
};

static const Model model = {
    .fmi = &fmu,
    .equations = offsetof(Functions, equations),
    .update = update3,
    .complete = complete,
    .differentiate = differentiate,
    .clocks = offsetof(Functions, clocks),
};

static void *instantiate(const Library *library, const Identity *identity) {
    void *instance = functions_of(library)->instantiate_equations(
        identity->name, identity->token, identity->resources, false, identity->logging,
        as_environment(identity), log_message_fmi3);
    return solved_take(&model, library, identity, instance);
}

static bool exchange(const Library *library, const Exchange *e) {
    return exchange_by(&exchange3, library, e);
}

const Fmi exchange3 = {
    .boolean_size = sizeof(bool),
    .bind = bind,
    .instantiate = instantiate,
    .choose_messages = solved_choose_messages,
    .exchange = exchange,
    SOLVED_FUNCTIONS,
    SOLVED_STATES,
};
