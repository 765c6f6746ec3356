/* One table of functions for all FMI versions and interfaces: what the pool needs for steps. */

#ifndef FMUGYM_FMI_H
#define FMUGYM_FMI_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "fmi/library.h"
#include "shared/floats.h"

/* FMI's own codes and two more. Status in fmugym/fmi/status.py has the same values. */
typedef enum {
    STATUS_OK = 0,
    STATUS_WARNING = 1,
    STATUS_DISCARD = 2,
    STATUS_ERROR = 3,
    STATUS_FATAL = 4,
    STATUS_TERMINATED = 6, /* the FMU asked to stop; its outputs are valid */
    STATUS_NOT_FINITE = 7  /* an output is NaN or infinite */
} Status;

/* The C types of values. fmugym/pool/pool_form.py uses the same numbers. FMI 1.0 and 2.0 have only
 * FLOAT64 (Real), INT32 (Integer), BOOLEAN and STRING. The functions get and set of Fmi do not take
 * STRING. */
typedef enum {
    TYPE_FLOAT64,
    TYPE_FLOAT32,
    TYPE_INT8,
    TYPE_INT16,
    TYPE_INT32,
    TYPE_INT64,
    TYPE_UINT8,
    TYPE_UINT16,
    TYPE_UINT32,
    TYPE_UINT64,
    TYPE_BOOLEAN,
    TYPE_CLOCK, /* whether it ticks; FMI 3.0 */
    TYPE_STRING,
    /* The same for negated aliases of FMI 1.0, whose values are those of the FMU with the other
     * sign; of a Boolean, its opposite. */
    TYPE_NEGATED_FLOAT64,
    TYPE_NEGATED_INT32,
    TYPE_NEGATED_BOOLEAN,
    NUMBER_OF_TYPES
} Type;

/* What instantiation needs. The strings live as long as the instance. */
typedef struct {
    const char *name;      /* unique in the process */
    const char *token;     /* GUID or instantiation token */
    const char *resources; /* a URI, in FMI 3.0 a path */
    uint64_t environment;  /* the same name as a number, for FMI 3.0 */
    bool logging;          /* whether the FMU logs everything, not only what it thinks necessary */
    const struct Solving *solving; /* of model exchange; see model_exchange/methods.h */
    const Floats *floats;          /* the environment in which the solver computes */
} Identity;

typedef struct {
    double start_time;
    double stop_time;
    double tolerance;
    bool has_stop_time;
    bool has_tolerance;
    /* FMI 3.0: the structural parameters that get other values than their start values. */
    size_t number_of_structural;
    const char *structural_references; /* 32-bit integers, not aligned */
    const char *structural_values;     /* 64-bit integers, not aligned */
} Experiment;

/* Callbacks for initialization; each returns a status. */
typedef struct {
    Status (*set)(void *context); /* sets the start values */
    void *context;
    Status (*prepare)(void *prepared); /* in initialization mode of FMI 3.0, or NULL */
    void *prepared;
    Status (*exchange)(void *context); /* with other FMUs in initialization mode, or NULL */
} StartValues;

static inline Status exchange_in(StartValues start_values) {
    return start_values.exchange == NULL ? STATUS_OK : start_values.exchange(start_values.context);
}

typedef enum { SETTING_INPUTS, DOING_STEP, READING_OUTPUTS } Stage;

typedef struct {
    Status status;
    Stage stage; /* the call that returned the status */
} Outcome;

/* Blocks of memory that each hold an instance, its inputs and its outputs, at the same offsets in
 * bytes. */
typedef struct {
    void *const *blocks;
    size_t component, inputs, outputs;
} Blocks;

/* One step for each of several instances. The step sets the inputs before and gets the outputs
 * after. places gives the row of each instance in the inputs and outputs. In blocks, which may be
 * NULL, the instances and their values are somewhere else. */
typedef struct {
    const uint32_t *input_references, *output_references;
    size_t number_of_inputs, number_of_outputs;
    double step;
    bool no_return; /* see do_step */
    size_t count;
    void *const *components;
    const uint32_t *places;
    const double *times;
    const Floats *floats; /* the environment that each instance must find */
    const double *inputs;
    double *outputs;
    Outcome *outcomes;
    const Blocks *blocks;
} Exchange;

/* A directional derivative: that of all unknowns along a direction of the knowns. An adjoint one of
 * FMI 3.0: that of a weighted sum of the unknowns by all knowns. */
typedef struct {
    bool adjoint;
    const uint32_t *unknowns, *knowns;
    size_t number_of_unknowns, number_of_knowns;
    const double *seed; /* the direction, or the weights */
    size_t size_of_seed, size_of_values;
} Derivation;

/* One FMI version. A Status that a function returns is one of FMI's own codes. PENDING and
 * unknown codes become ERROR, and so does a call of a function that the FMU does not export. */
typedef struct Fmi {
    size_t boolean_size;

    /* Looks up all functions. Returns whether the required ones exist; if not, error says why. */
    bool (*bind)(Library *library, char *error, size_t size);

    void *(*instantiate)(const Library *library, const Identity *identity);
    /* Asks for messages of these categories; for none if count is 0. NULL in FMI 1.0, which has no
     * categories. An FMU without the function returns OK. */
    Status (*choose_messages)(const Library *library, void *component,
                              const char *const *categories, size_t count);
    /* Sets doing to the name of the call that failed. */
    Status (*initialize)(const Library *library, void *component, const Experiment *experiment,
                         StartValues start_values, const char **doing);
    /* no_return promises that no state from before this time will be restored. */
    Status (*do_step)(const Library *library, void *component, double time, double step,
                      bool no_return);
    /* Does steps whose inputs and outputs are all scalars of type FLOAT64. Each version implements it with
     * exchange_by. Returns whether all steps are OK. */
    bool (*exchange)(const Library *library, const Exchange *exchange);
    /* size is the number of values; in FMI 3.0 a value reference may be that of an array. */
    Status (*get)(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, void *values, size_t size);
    Status (*set)(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, const void *values, size_t size);
    Status (*set_string)(const Library *library, void *component, uint32_t reference,
                         const char *text);
    Status (*reset)(const Library *library, void *component);
    Status (*terminate)(const Library *library, void *component);
    void (*free_instance)(const Library *library, void *component);
    /* NULL in FMI 1.0 and for systems. */
    Status (*derive)(const Library *library, void *component, const Derivation *derivation,
                     double *values);

    /* FMU states; NULL in FMI 1.0. */
    Status (*get_state)(const Library *library, void *component, void **state);
    Status (*set_state)(const Library *library, void *component, void *state);
    Status (*free_state)(const Library *library, void *component, void **state);
    /* The serialized size, or 0 if the FMU does not report it. */
    size_t (*state_size)(const Library *library, void *component, void *state);
    Status (*serialize)(const Library *library, void *component, void *state, char *bytes,
                        size_t size);
    Status (*deserialize)(const Library *library, void *component, const char *bytes, size_t size,
                          void **state);

    /* Of systems, otherwise NULL: which FMU failed last, or NULL; and freeing what may still be freed
     * after a fatal error. */
    const char *(*blamed)(const void *component);
    void (*drop)(const Library *library, void *component);
} Fmi;

/* How an FMU is run. fmugym/pool/pool_form.py has the same numbers. */
typedef enum {
    CO_SIMULATION_ALONE,
    MODEL_EXCHANGE_SOLVED,
    CO_SIMULATION_WITH_EVENTS,
    NUMBER_OF_MANNERS
} Manner;

extern const Fmi fmi1, fmi2, fmi3, exchange1, exchange2, exchange3, events3;
/* Of systems. */
extern const Fmi composite;

/* NULL if the version has no such manner. Version 0 are systems. */
const Fmi *fmi_table(int64_t version, int64_t manner);

/* Of one value, in bytes. */
static inline size_t value_size(const Fmi *fmi, Type type) {
    static const size_t sizes[NUMBER_OF_TYPES] = {8, 4, 1, 2, 4, 8, 1, 2, 4, 8, 0, 1, 0, 8, 4, 1};
    return type == TYPE_BOOLEAN ? fmi->boolean_size : sizes[type];
}

static inline bool has_outputs(Outcome outcome) {
    return outcome.stage == DOING_STEP &&
           (outcome.status <= STATUS_WARNING || outcome.status == STATUS_TERMINATED);
}

/* An instance and its values. */
typedef struct {
    void *component;
    const double *inputs;
    double *outputs;
} Stepper;

static inline Stepper stepper_of_run(const Exchange *e, size_t index) {
    return (Stepper){e->components[index], e->inputs + e->places[index] * e->number_of_inputs,
                     e->outputs + e->places[index] * e->number_of_outputs};
}

static inline Stepper stepper_of_block(const Blocks *blocks, size_t index) {
    char *block = blocks->blocks[index];
    return (Stepper){*(void **)(void *)(block + blocks->component),
                     (const double *)(void *)(block + blocks->inputs),
                     (double *)(void *)(block + blocks->outputs)};
}

static inline Outcome exchange_once(const Fmi *fmi, const Library *library, const Exchange *e,
                                    Stepper me, double time) {
    Outcome outcome = {.stage = SETTING_INPUTS};

    if (e->number_of_inputs > 0) {
        outcome.status = fmi->set(library, me.component, TYPE_FLOAT64, e->input_references,
                                  e->number_of_inputs, me.inputs, e->number_of_inputs);
    }
    if (outcome.status <= STATUS_WARNING) {
        outcome.stage = DOING_STEP;
        outcome.status = fmi->do_step(library, me.component, time, e->step, e->no_return);
    }
    if (has_outputs(outcome)) {
        const Status got = fmi->get(library, me.component, TYPE_FLOAT64, e->output_references,
                                    e->number_of_outputs, me.outputs, e->number_of_outputs);
        outcome = got > STATUS_WARNING ? (Outcome){got, READING_OUTPUTS} : outcome;
    }
    return outcome;
}

static inline bool exchange_blocks(const Fmi *fmi, const Library *library,
                                   const Exchange *exchange) {
    const Exchange e = *exchange;
    const Blocks blocks = *exchange->blocks;
    bool good = true;

    for (size_t i = 0; i < e.count; i++) {
        e.outcomes[i] = exchange_once(fmi, library, &e, stepper_of_block(&blocks, i), e.times[i]);
        floats_restore_if_seen(e.floats);
        good &= e.outcomes[i].status == STATUS_OK;
    }
    return good;
}

/* For the source files of the FMI versions. The compiler sees their tables there and turns the
 * calls into direct ones. */
static inline bool exchange_by(const Fmi *fmi, const Library *library, const Exchange *exchange) {
    const Exchange e = *exchange; /* a local copy, so the compiler knows that no FMU changes it */
    bool good = true;

    if (exchange->blocks != NULL) {
        return exchange_blocks(fmi, library, exchange);
    }
    for (size_t i = 0; i < e.count; i++) {
        e.outcomes[i] = exchange_once(fmi, library, &e, stepper_of_run(&e, i), e.times[i]);
        floats_restore_if_seen(e.floats);
        good &= e.outcomes[i].status == STATUS_OK;
    }
    return good;
}

static inline Status sane(int status) {
    return status >= STATUS_OK && status <= STATUS_FATAL ? (Status)status : STATUS_ERROR;
}

#endif
