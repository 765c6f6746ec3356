/* Co-simulation of FMI 3.0 with inputs and outputs at intermediate updates. */

#include "fmi3.h"
#include "solved.h"

static Status step(const Library *library, void *instance, double time, double size,
                   double *reached, bool *event, bool *terminate) {
    (void)reached, (void)event, (void)terminate;
    return fmi3.do_step(library, instance, time, size, false);
}

static const Model model = {.fmi = &fmi3, .step = step, .updates = true};

static bool bind(Library *library, char *error, size_t size) {
    return fmi3.bind(library, error, size);
}

static void *instantiate(const Library *library, const Identity *identity) {
    return solved_take(&model, library, identity, instantiate_steps(library, identity, false));
}

static bool exchange(const Library *library, const Exchange *e) {
    return exchange_by(&updated3, library, e);
}

const Fmi updated3 = {
    .boolean_size = sizeof(bool),
    .bind = bind,
    .instantiate = instantiate,
    .choose_messages = solved_choose_messages,
    .exchange = exchange,
    SOLVED_FUNCTIONS,
    SOLVED_STATES,
};
