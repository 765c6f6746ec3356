/* FMI 2.0 for co-simulation. */

#include "fmi2.h"

enum { CO_SIMULATION = 1, TERMINATED = 3 /* fmi2Terminated of fmi2StatusKind */ };

static const Binding bindings[] = {
    SHARED_BINDINGS,
    {"DoStep", offsetof(Functions, do_step), true},
    {"GetBooleanStatus", offsetof(Functions, get_boolean_status), false},
};

static bool bind(Library *library, char *error, size_t size) {
    return library_bind(library, "fmi2", bindings, COUNT_OF(bindings), sizeof(Functions),
                        error, size);
}

static void *instantiate(const Library *library, const Identity *identity) {
    return instantiate_as(CO_SIMULATION, library, identity);
}

/* Finds out what a discarded step means. An FMU that cannot report the reason counts as
 * discarding. */
static Status judge_discard(const Functions *f, void *component) {
    int terminated = 0;

    if (f->get_boolean_status == NULL) {
        return STATUS_DISCARD;
    }
    const Status status = sane(f->get_boolean_status(component, TERMINATED, &terminated));
    if (status == STATUS_FATAL) {
        return status;
    }
    return status <= STATUS_WARNING && terminated != 0 ? STATUS_TERMINATED : STATUS_DISCARD;
}

static Status do_step(const Library *library, void *component, double time, double step,
                      bool no_return) {
    const Functions *f = functions_of(library);
    const Status status = sane(f->do_step(component, time, step, no_return));
    return status == STATUS_DISCARD ? judge_discard(f, component) : status;
}

static bool exchange(const Library *library, const Exchange *e) {
    return exchange_by(&fmi2, library, e);
}

const Fmi fmi2 = {
    .boolean_size = sizeof(int),
    .bind = bind,
    .instantiate = instantiate,
    .choose_messages = choose_messages,
    .initialize = initialize,
    .do_step = do_step,
    .exchange = exchange,
    .get = older_get,
    .set = older_set,
    .set_string = older_set_string,
    SHARED_FUNCTIONS,
    SHARED_STATES,
};
