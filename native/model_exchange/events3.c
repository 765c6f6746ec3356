/* FMI 3.0 for co-simulation with event mode: the pool handles the events between the FMU's steps. */

#include "fmi/fmi3.h"
#include "model_exchange/solved.h"

static const Binding bindings[] = {
    SHARED_BINDINGS,
    BINDINGS_OF_EVENTS,
    {"InstantiateCoSimulation", offsetof(Functions, instantiate_steps), true},
    {"DoStep", offsetof(Functions, do_step), true},
    {"EnterStepMode", offsetof(Functions, equations.enter_continuous), true},
};

static bool bind(Library *library, char *error, size_t size) {
    return library_bind(library, "fmi3", bindings, COUNT_OF(bindings), sizeof(Functions),
                        error, size);
}

static Status step(const Library *library, void *instance, double time, double size,
                   double *reached, bool *event, bool *terminate) {
    bool early_return = false;
    double last_successful_time = time + size;
    const Status status =
        sane(functions_of(library)->do_step(instance, time, size, false, event, terminate,
                                            &early_return, &last_successful_time));

    if (early_return) {
        *reached = last_successful_time;
    }
    return status;
}

/* The FMU itself, without what handles its events. */
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
    .clocks = offsetof(Functions, clocks),
    .update = update3,
    .step = step,
};

static void *instantiate(const Library *library, const Identity *identity) {
    return solved_take(&model, library, identity, instantiate_steps(library, identity, true));
}

static bool exchange(const Library *library, const Exchange *e) {
    return exchange_by(&events3, library, e);
}

const Fmi events3 = {
    .boolean_size = sizeof(bool),
    .bind = bind,
    .instantiate = instantiate,
    .choose_messages = solved_choose_messages,
    .exchange = exchange,
    SOLVED_FUNCTIONS,
    SOLVED_STATES,
};
