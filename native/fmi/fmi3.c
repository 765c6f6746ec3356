/* FMI 3.0 for co-simulation: the FMU handles its events within its steps. */

#include "fmi/fmi3.h"

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
    return instantiate_steps(library, identity, false);
}

/* Sets early to the time at which the FMU returned, if that is before the end of the step. */
static Status step_once(const Library *library, void *instance, double time, double step,
                        bool no_return, double *early) {
    bool event_handling_needed = false, terminate = false, early_return = false;
    double reached = time;
    const Status status =
        sane(functions_of(library)->do_step(instance, time, step, no_return, &event_handling_needed,
                                            &terminate, &early_return, &reached));

    if (status <= STATUS_WARNING && terminate) {
        return STATUS_TERMINATED;
    }
    if (status <= STATUS_WARNING && early_return) {
        *early = reached;
    }
    return status;
}

/* Some FMUs return early although it is not allowed: then the rest of the step follows. */
static Status do_step(const Library *library, void *instance, double time, double step,
                      bool no_return) {
    const double end = time + step;
    double early = end;
    Status status = step_once(library, instance, time, step, no_return, &early);

    while (status <= STATUS_WARNING && early < end) {
        const double reached = early;
        if (!(reached > time)) {
            return STATUS_DISCARD;
        }
        time = reached;
        early = end;
        status = step_once(library, instance, time, end - time, no_return, &early);
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
    .derive = derive,
    SHARED_FUNCTIONS,
    SHARED_STATES,
};
