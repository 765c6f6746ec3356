/* FMI 2.0 for co-simulation. */

#include "fmi/fmi2.h"
#include "shared/platform.h"

enum { CO_SIMULATION = 1 };
enum { LAST_SUCCESSFUL_TIME = 2, TERMINATED = 3 }; /* of fmi2StatusKind */

static const Binding bindings[] = {
    SHARED_BINDINGS,
    {"DoStep", offsetof(Functions, do_step), true},
    {"GetBooleanStatus", offsetof(Functions, get_boolean_status), false},
    {"GetRealStatus", offsetof(Functions, get_real_status), false},
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

/* The time at which a discarded step ended; the FMU need not tell it. */
static double last_successful_time(const Functions *f, void *component, double time) {
    double last = time;

    if (f->get_real_status == NULL ||
        sane(f->get_real_status(component, LAST_SUCCESSFUL_TIME, &last)) > STATUS_WARNING) {
        return time;
    }
    return last;
}

/* Does the rest of a discarded step, from where the FMU returned. An FMU that has done nothing of
 * it, or refuses to go on, has discarded it. */
NEVER_INLINE static Status go_on(const Functions *f, void *component, double time, double end, bool no_return) {
    Status status = judge_discard(f, component);

    while (status == STATUS_DISCARD) {
        const double reached = last_successful_time(f, component, time);
        if (!(reached > time && reached < end)) {
            return STATUS_DISCARD;
        }
        time = reached;
        status = sane(f->do_step(component, time, end - time, no_return));
        if (status == STATUS_ERROR) {
            return STATUS_DISCARD;
        }
        status = status == STATUS_DISCARD ? judge_discard(f, component) : status;
    }
    return status;
}

static Status do_step(const Library *library, void *component, double time, double step,
                      bool no_return) {
    const Functions *f = functions_of(library);
    const Status status = sane(f->do_step(component, time, step, no_return));
    return status == STATUS_DISCARD ? go_on(f, component, time, time + step, no_return) : status;
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
    .derive = derive,
    SHARED_FUNCTIONS,
    SHARED_STATES,
};
