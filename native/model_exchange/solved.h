/* An FMU of model exchange and the solver of its equations, behind the functions of co-simulation.
 * A component here is a Solver. */

#ifndef FMUGYM_SOLVED_H
#define FMUGYM_SOLVED_H

#include "model_exchange/solver.h"

/* The rest of instantiation: takes over the component of the FMU, which may be NULL. Frees it and
 * returns NULL if there is no memory. */
void *solved_take(const Model *model, const Library *library, const Identity *identity,
                  void *component);

/* Like the functions of Fmi. */
Status solved_choose_messages(const Library *library, void *component,
                              const char *const *categories, size_t count);
Status solved_initialize(const Library *library, void *component, const Experiment *experiment,
                         StartValues start_values, const char **doing);
Status solved_do_step(const Library *library, void *component, double time, double step,
                      bool no_return);
Status solved_get(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, void *values, size_t size);
Status solved_set(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, const void *values, size_t size);
Status solved_set_string(const Library *library, void *component, uint32_t reference,
                         const char *text);
Status solved_derive(const Library *library, void *component, const Derivation *derivation,
                     double *values);
Status solved_reset(const Library *library, void *component);
Status solved_terminate(const Library *library, void *component);
void solved_free(const Library *library, void *component);
Status solved_get_state(const Library *library, void *component, void **state);
Status solved_set_state(const Library *library, void *component, void *state);
Status solved_free_state(const Library *library, void *component, void **state);
size_t solved_state_size(const Library *library, void *component, void *state);
Status solved_serialize(const Library *library, void *component, void *state, char *bytes,
                        size_t size);
Status solved_deserialize(const Library *library, void *component, const char *bytes, size_t size,
                          void **state);

/* The part of the table of an FMI version that is the same for all, and the FMU states. */
#define SOLVED_FUNCTIONS                                                                           \
    .initialize = solved_initialize, .do_step = solved_do_step, .get = solved_get,                 \
    .set = solved_set, .set_string = solved_set_string,                                            \
    .derive = solved_derive, .reset = solved_reset, .terminate = solved_terminate,                 \
    .free_instance = solved_free
#define SOLVED_STATES                                                                              \
    .get_state = solved_get_state, .set_state = solved_set_state,                                  \
    .free_state = solved_free_state, .state_size = solved_state_size,                              \
    .serialize = solved_serialize, .deserialize = solved_deserialize

#endif
