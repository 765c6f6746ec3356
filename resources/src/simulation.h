/* An instance of the model: what the FMI versions have in common. */

#ifndef SIMULATION_H
#define SIMULATION_H

#include <stdbool.h>

#include "model.h"

/* Enumerations are of type Integer in FMI 1.0 and 2.0, of type Int64 in FMI 3.0. */
#if FMI_VERSION == 3
typedef int64_t Integer;
#else
typedef int32_t Integer;
#endif

/* The values that the status types of all FMI versions share. */
typedef enum { STATUS_OK = 0, STATUS_DISCARD = 2, STATUS_ERROR = 3 } Status;

/* One bit each, so that a set of phases is a mask. */
typedef enum {
    PHASE_INSTANTIATED = 1,
    PHASE_EXPERIMENT_SET_UP = 2,
    PHASE_INITIALIZATION = 4,
    PHASE_STEP = 8,
    PHASE_TERMINATED = 16
} Phase;

/* Everything that an FMU state consists of: no pointers, so it can be serialized as it is. */
typedef struct {
    Reals reals;
    Constants constants;
    double stop_time; /* infinite if undefined */
    int32_t enumerations[NUMBER_OF_ENUMERATIONS];
    int32_t phase;
    int32_t stale;       /* something changed since the last refresh */
    int32_t step_status; /* of the last doStep */
} Simulation;

typedef struct {
    Simulation simulation;
    void *memory; /* in which it lies */
    const char *name;
    uint32_t muted; /* log categories switched off: one bit per status */
} Instance;

/* Provided by the functions of the FMI version: its token, and the importer's logger. */
extern const char model_token[];
void emit_message(const Instance *instance, Status status, const char *category,
                  const char *message);

/* Instances. instance_create allocates size bytes, which begin with an Instance. */
Instance *instance_create(size_t size, const char *name);
void instance_free(Instance *instance);
bool accepts(const Instance *instance, const char *function, const char *token);
Status reset(Instance *instance, const char *function);

/* What is rare is kept out of the way of the rest. */
#define RARE [[gnu::cold, gnu::noinline]]

/* Logging. report passes on a message in the status's category, and returns the status. */
RARE Status report(const Instance *instance, Status status, const char *function, const char *format,
              ...);
Status set_logging(Instance *instance, const char *function, bool on, size_t number,
                   const char *const categories[]);

/* For functions of a capability that the model description does not declare. */
Status not_supported(const Instance *instance, const char *function);
Status no_such_status(const Instance *instance, const char *function);

/* The state machine. Every function checks that the present phase allows it. */
enum { ANY_PHASE = ~0 };
Status check_phase(const Instance *instance, const char *function, int32_t allowed);
Status set_up_experiment(Instance *instance, const char *function, double start_time,
                         bool stop_time_defined, double stop_time);
Status enter_initialization(Instance *instance, const char *function);
Status exit_initialization(Instance *instance, const char *function);
Status do_step(Instance *instance, const char *function, double time, double step);
Status terminate(Instance *instance, const char *function);

/* Brings the variables that are calculated on demand up to date. */
Status refresh(Instance *instance, const char *function);

/* Values. A call that fails changes nothing. */
Status get_reals(Instance *instance, const char *function, const uint32_t references[],
                 size_t number, double values[]);
Status set_reals(Instance *instance, const char *function, const uint32_t references[],
                 size_t number, const double values[]);
Status get_enumerations(const Instance *instance, const char *function,
                        const uint32_t references[], size_t number, Integer values[]);
Status set_enumerations(Instance *instance, const char *function, const uint32_t references[],
                        size_t number, const Integer values[]);
Status no_such_variables(const Instance *instance, const char *function, size_t number);

/* Partial derivatives of outputs and derivatives with respect to states and inputs. */
Status directional_derivative(Instance *instance, const char *function, const uint32_t unknowns[],
                              size_t number_of_unknowns, const uint32_t knowns[],
                              size_t number_of_knowns, const double seed[], double sensitivity[]);

/* FMU states. */
Status get_state(const Instance *instance, const char *function, void **state);
Status set_state(Instance *instance, const char *function, const void *state);
Status free_state(const Instance *instance, const char *function, void **state);
Status serialized_size(const Instance *instance, const char *function, size_t *size);
Status serialize_state(const Instance *instance, const char *function, const void *state,
                       void *bytes, size_t size);
Status deserialize_state(const Instance *instance, const char *function, const void *bytes,
                         size_t size, void **state);

#endif
