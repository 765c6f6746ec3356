/* Co-simulation of FMI 1.0 and 2.0 with inputs that change linearly within a step. */

#include "shared.h"
#include "solved.h"

static Status step_by(const Fmi *fmi, const Library *library, void *component, double time,
                      double size) {
    return fmi->do_step(library, component, time, size, false);
}

static Status step1(const Library *library, void *component, double time, double size,
                    double *reached, bool *event, bool *terminate) {
    (void)reached, (void)event, (void)terminate;
    return step_by(&fmi1, library, component, time, size);
}

static Status step2(const Library *library, void *component, double time, double size,
                    double *reached, bool *event, bool *terminate) {
    (void)reached, (void)event, (void)terminate;
    return step_by(&fmi2, library, component, time, size);
}

static const Model model1 = {.fmi = &fmi1, .step = step1};
static const Model model2 = {.fmi = &fmi2, .step = step2};

static bool bind1(Library *library, char *error, size_t size) {
    return fmi1.bind(library, error, size);
}

static bool bind2(Library *library, char *error, size_t size) {
    return fmi2.bind(library, error, size);
}

static void *instantiate1(const Library *library, const Identity *identity) {
    return solved_take(&model1, library, identity, fmi1.instantiate(library, identity));
}

static void *instantiate2(const Library *library, const Identity *identity) {
    return solved_take(&model2, library, identity, fmi2.instantiate(library, identity));
}

static bool exchange_ramped1(const Library *library, const Exchange *e) {
    return exchange_by(&ramped1, library, e);
}

static bool exchange_ramped2(const Library *library, const Exchange *e) {
    return exchange_by(&ramped2, library, e);
}

const Fmi ramped1 = {
    .boolean_size = sizeof(char),
    .bind = bind1,
    .instantiate = instantiate1,
    .exchange = exchange_ramped1,
    SOLVED_FUNCTIONS,
};

const Fmi ramped2 = {
    .boolean_size = sizeof(int),
    .bind = bind2,
    .instantiate = instantiate2,
    .choose_messages = solved_choose_messages,
    .exchange = exchange_ramped2,
    SOLVED_FUNCTIONS,
    SOLVED_STATES,
};
