/* The FMI versions behind one table of functions: what the pool needs of co-simulation. */

#ifndef FMUGYM_FMI_H
#define FMUGYM_FMI_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "library.h"

/* FMI's own codes, and two of ours; the same values as fmugym.adapters.Status. */
typedef enum {
    STATUS_OK = 0,
    STATUS_WARNING = 1,
    STATUS_DISCARD = 2,
    STATUS_ERROR = 3,
    STATUS_FATAL = 4,
    STATUS_TERMINATED = 6, /* the FMU asked to stop; its outputs are valid */
    STATUS_NOT_FINITE = 7  /* an output is NaN or infinite */
} Status;

/* The C types of values, as module.c and fmugym/pool/native.py number them. FMI 1.0 and 2.0 have
 * only FLOAT64 (Real), INT32 (Integer) and BOOLEAN. */
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
    NUMBER_OF_TYPES
} Type;

/* What instantiation needs. The strings live as long as the instance. */
typedef struct {
    const char *name;      /* unique in the process */
    const char *token;     /* GUID or instantiation token */
    const char *resources; /* a URI, in FMI 3.0 a path */
    uint64_t environment;  /* the same name as a number, for FMI 3.0 */
    bool logging;
} Identity;

typedef struct {
    double start_time;
    double stop_time;
    double tolerance;
    bool has_stop_time;
    bool has_tolerance;
} Experiment;

/* Called where start values are due; returns a status. */
typedef struct {
    Status (*set)(void *context);
    void *context;
} StartValues;

/* A step together with the setting of its inputs and the getting of its outputs. */
typedef struct {
    const uint32_t *input_references, *output_references;
    size_t number_of_inputs, number_of_outputs;
    double time, step;
    bool no_return; /* see do_step */
    const double *inputs;
    double *outputs;
} Exchange;

typedef enum { SETTING_INPUTS, DOING_STEP, READING_OUTPUTS } Stage;

/* One FMI version. Every function returns one of FMI's own codes, PENDING and unknown ones turned
 * into ERROR; a function that the FMU does not export gives ERROR. */
typedef struct Fmi {
    size_t boolean_size;

    /* Looks up all functions. Returns whether those are there that nothing can do without; if not,
     * error tells why. */
    bool (*bind)(Library *library, char *error, size_t size);

    void *(*instantiate)(const Library *library, const Identity *identity);
    /* doing is set to the call that failed. */
    Status (*initialize)(const Library *library, void *component, const Experiment *experiment,
                         StartValues start_values, const char **doing);
    /* no_return promises that no state from before this time will be restored. */
    Status (*do_step)(const Library *library, void *component, double time, double step,
                      bool no_return);
    /* Does a step with inputs and outputs that are all FLOAT64; what exchange_by makes of the version.
     * stage is set to the call that the status is of; outputs are got if the step succeeded or was the last. */
    Status (*exchange)(const Library *library, void *component, const Exchange *exchange,
                       Stage *stage);
    Status (*get)(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, void *values);
    Status (*set)(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, const void *values);
    Status (*set_string)(const Library *library, void *component, uint32_t reference,
                         const char *text);
    Status (*reset)(const Library *library, void *component);
    Status (*terminate)(const Library *library, void *component);
    void (*free_instance)(const Library *library, void *component);

    /* FMU states; NULL in FMI 1.0. */
    Status (*get_state)(const Library *library, void *component, void **state);
    Status (*set_state)(const Library *library, void *component, void *state);
    Status (*free_state)(const Library *library, void *component, void **state);
    /* The serialized size, 0 if the FMU does not tell. */
    size_t (*state_size)(const Library *library, void *component, void *state);
} Fmi;

extern const Fmi fmi1, fmi2, fmi3;

/* For the versions' own files: with a table that the compiler sees, calls become direct ones. */
static inline Status exchange_by(const Fmi *fmi, const Library *library, void *component,
                                 const Exchange *e, Stage *stage) {
    *stage = SETTING_INPUTS;
    Status status = fmi->set(library, component, TYPE_FLOAT64, e->input_references,
                             e->number_of_inputs, e->inputs);
    if (status > STATUS_WARNING) {
        return status;
    }
    *stage = DOING_STEP;
    status = fmi->do_step(library, component, e->time, e->step, e->no_return);
    if (status > STATUS_WARNING && status != STATUS_TERMINATED) {
        return status;
    }
    const Status got = fmi->get(library, component, TYPE_FLOAT64, e->output_references,
                                e->number_of_outputs, e->outputs);
    if (got > STATUS_WARNING) {
        *stage = READING_OUTPUTS;
        return got;
    }
    return status;
}

static inline Status sane(int status) {
    return status >= STATUS_OK && status <= STATUS_FATAL ? (Status)status : STATUS_ERROR;
}

#endif
