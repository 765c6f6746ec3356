/* FMI 3.0 for co-simulation, without event mode, early return and intermediate update. */

#include "fmi3.h"

static const Binding bindings[] = {
    SHARED_BINDINGS,
    {"InstantiateCoSimulation", offsetof(Functions, instantiate_steps), true},
    {"DoStep", offsetof(Functions, do_step), true},
};

static bool bind(Library *library, char *error, size_t size) {
    return library_bind(library, "fmi3", bindings, COUNT_OF(bindings), sizeof(Functions),
                        error, size);
}

static void *instantiate(const Library *library, const Identity *identity) {
    return functions_of(library)->instantiate_steps(
        identity->name, identity->token, identity->resources, false, identity->logging, false,
        false, NULL, 0, environment_of(identity), log_message_fmi3, NULL);
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
    .get = get3,
    .set = set3,
    .set_string = set_string3,
    SHARED_FUNCTIONS,
    SHARED_STATES,
};
