/* A system: several FMUs that look like one. Its instances have an instance of each FMU.
 *
 * All values of a system are FLOAT64; its parts convert them to the types of their FMUs. A value
 * reference is an index of its variables. */

#ifndef FMUGYM_SYSTEM_H
#define FMUGYM_SYSTEM_H

#include "fmi/access.h"
#include "fmi/fmi.h"
#include "model_exchange/methods.h"
#include "system/loops.h"

typedef struct {
    uint32_t reference;
    const char *text;
} PartString;

/* How a part begins an episode, from the fastest way to the surest. fmugym/pool/pool_form.py has the
 * same numbers. */
typedef enum {
    METHOD_RESTORE,  /* returns to its state after the initialization, if start values are the same */
    METHOD_RESET,
    METHOD_INSTANCE, /* is made anew */
    METHOD_LIBRARY   /* and its private library is loaded anew */
} ResetMethod;

/* An FMU of the system. */
typedef struct Component {
    const char *name;
    const char *label;      /* names it in messages */
    const char *not_finite; /* the same if its outputs are not finite */
    const Fmi *fmi;
    const char *model, *token, *resources;
    const char **categories;
    size_t number_of_categories;
    bool has_mode; /* whether its FMI version has an Initialization Mode */
    ResetMethod reset_method;
    int64_t steps; /* in one of the system */
    Solving solving;
    Access inputs, outputs; /* what a step sets and gets, in the order of the slots */
    const double *input_starts;
    size_t first_input, first_output; /* its first slots */
    size_t first_route, end_route;    /* the routes to its inputs */
    Access starts;                    /* what is set before initialization */
    const double *start_values;
    PartString *strings;
    size_t number_of_strings;
    size_t number_of_structural; /* see Experiment */
    const char *structural_references, *structural_values;
} Component;

/* target = gain * source + offset; without arithmetic if they are 1 and 0. */
typedef struct {
    double gain, offset;
    bool plain;
} Scale;

static inline double scaled(Scale scale, double value) {
    return scale.plain ? value : scale.gain * value + scale.offset;
}

/* From slots of outputs to as many slots of inputs: one, or those of a whole array. */
typedef struct {
    uint32_t source, target, source_part, target_part, count;
    Scale scale;
} Route;

/* A scalar or an element of an FMU behind one of the system. */
typedef struct {
    uint32_t part;
    Type type;
    Element element;
    int32_t input, output; /* its slots, or -1 */
    const double *starts;  /* of all elements of its array; NULL for a scalar */
    Scale scale;           /* from the variable of the system, if that is set */
    Scale reading;         /* to the variable of the system */
} End;

/* Parts that step one after the other; or a loop, whose inner routes carry what it solves for. */
typedef struct {
    const uint32_t *parts;
    size_t count;
    const uint32_t *routes;
    size_t number_of_routes;
    size_t unknowns; /* the values that the routes carry */
    bool has_loop;
    LoopLimits loop;
    const char *label; /* names it in messages */
} PartGroup;

/* Routes of the initialization, one after the other or solved for together. */
typedef struct {
    const uint32_t *routes;
    size_t count;
    size_t unknowns; /* the values that they carry */
    bool has_loop;
    LoopLimits loop;
    const char *label;
} Transfer;

typedef struct System {
    Component *parts;
    size_t count;
    size_t inputs, outputs; /* numbers of slots */
    Route *routes;          /* sorted by the parts of their targets */
    size_t number_of_routes;
    PartGroup *groups;
    size_t number_of_groups;
    Transfer *transfers;
    size_t number_of_transfers;
    End *ends;
    const uint32_t *first_ends; /* of each variable; one more */
    size_t number_of_variables;
    bool jacobi;
    bool restores; /* whether a part begins by METHOD_RESTORE */
    bool renews;   /* whether a part is made anew */
    bool private_libraries; /* whether each instance has its own libraries */
    size_t largest_state; /* of a part that is kept, in bytes */
    size_t memory; /* doubles that the largest loop needs */
    size_t scratch; /* doubles that the longest list of variables of a part needs */
    uint32_t *clocks; /* the slots of inputs that are clocks */
    size_t number_of_clocks;
} System;

/* A value that is to be set before the initialization. */
typedef struct {
    const End *end;
    double value;
    const char *text; /* of a String, or NULL */
    bool done;        /* with another element of its array */
} Pending;

/* What becomes of the values of an array, or of the value of a scalar, before they are set. */
typedef struct {
    void (*make)(void *context, const End *end, double *values);
    void *context;
} Change;

/* One place for each part. */
typedef struct {
    bool *dead;    /* the parts for which no call is legal */
    bool *started; /* the parts that have left instantiation */
    bool *failed;  /* the parts for which only a reset is legal */
    void **before; /* states at the begin of a step */
    char *names; /* of LOG_NAME bytes each */
} PartPlaces;

/* The start that parts return to; see system_reset.c. */
typedef struct {
    void **states;      /* of the parts that restore; of others NULL */
    double *slots;      /* the inputs and outputs */
    char *key, *wanted; /* what was set before the last initialization, and before this one */
    size_t size, size_wanted;
    bool known;   /* whether the states are there */
    bool stepped; /* whether there were steps since the last initialization */
    bool *useless; /* the parts for which restoring did not work */
} KeptStart;

/* One instance. A step uses only one block of memory: this, the components and the slots. */
typedef struct {
    const System *system;
    Library *libraries; /* of the parts */
    const char *const *paths; /* of these */
    const Floats *floats;
    const char *blamed; /* who failed last, or NULL */
    void **components;
    double *inputs, *outputs; /* the slots */
    bool is_fresh;            /* whether the output slots are what the parts would tell */
    bool is_collecting;       /* whether values to be set are pending */
    bool terminated;          /* whether a part has asked to stop in this step */
    PartPlaces parts;
    KeptStart kept;
    uint64_t environment; /* of the first part */
    bool logging;
    bool hears, has_chosen; /* whether the parts are asked for messages, if they were told */
    double *loop, *typed, *whole; /* scratch memory: of loops; for the values of a part */
    Pending *pending;
    size_t number_pending, room;
} Composite;

/* Loads the libraries of all parts into one that stands for them. */
bool system_load(Library *library, const System *system, const char *const *paths, char *error,
                 size_t size);
void system_unload(Library *library);

/* The source files of systems share what follows. */

void *system_instantiate(const Library *library, const Identity *identity);
void system_free(const Library *library, void *component);
/* Frees what may still be freed after a fatal error. */
void system_drop(const Library *library, void *component);
Status system_choose_messages(const Library *library, void *component,
                              const char *const *categories, size_t count);
Status system_initialize(const Library *library, void *component, const Experiment *experiment,
                         StartValues start_values, const char **doing);
/* A communication step of a system. */
typedef struct {
    double time, step;
    bool no_return;
} Span;

/* Sets the inputs of a part, lets it step, and reads its outputs. */
Status system_step_part(Composite *me, size_t index, Span span);
/* The step of the parts of an algebraic loop. */
Status system_solve(Composite *me, const PartGroup *group, Span span);
/* Each tick of a clock is for one step only. */
void system_end_ticks(Composite *me);
/* Steps of many systems, see system_exchange.c. */
bool system_exchange(const Library *library, const Exchange *e);
Status system_do_step(const Library *library, void *component, double time, double step,
                      bool no_return);
Status system_reset(const Library *library, void *component);
Status system_terminate(const Library *library, void *component);
Status system_get(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, void *values, size_t size);
Status system_set(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, const void *values, size_t size);
Status system_set_string(const Library *library, void *component, uint32_t reference,
                         const char *text);
Status system_get_state(const Library *library, void *component, void **state);
Status system_set_state(const Library *library, void *component, void *state);
Status system_free_state(const Library *library, void *component, void **state);
size_t system_state_size(const Library *library, void *component, void *state);
Status system_serialize(const Library *library, void *component, void *state, char *bytes,
                        size_t size);
Status system_deserialize(const Library *library, void *component, const char *bytes, size_t size,
                          void **state);

/* What system_library.c and system_reset.c share: making a part, and freeing it with its states. */
bool part_instantiate(Composite *me, size_t index);
void part_free(Composite *me, size_t index);
void part_free_state(Composite *me, size_t index, void **state); /* if there is one */
Status part_choose_messages(Composite *me, size_t index);
/* Loads the library of a part anew, which must be private. */
bool part_reload(Composite *me, size_t index);

/* The start that parts return to. */
/* Notes what is set before the initialization that comes. */
bool start_note(Composite *me, double start_time);
/* Whether this initialization can return to the last one. */
bool start_is_kept(const Composite *me);
/* Resets the parts that could have been restored. */
Status start_reset_restoring(Composite *me);
/* Restores the states and slots. */
Status start_restore(Composite *me);
/* Whether the outputs are those of the kept start. */
bool start_is_the_same(const Composite *me);
/* Keeps the states of the parts that restore, if the same values were set before. */
Status start_keep(Composite *me);
/* Lets the parts that restored something else be restored no more, or all if none is to blame. */
void start_blame(Composite *me);
/* Returns all parts that do not restore to where they were made. */
Status start_give_up(Composite *me);

/* Notes a status of a part, and restores the floating-point environment. Returns the status. */
Status part_judge(Composite *me, size_t index, Status status);
/* Sets the inputs of a part to its slots; and fills the slots of its outputs. The caller judges the
 * status. */
Status part_set_inputs(Composite *me, size_t index);
/* Differentiates variables of a part, after its inputs were set. */
Status part_derive(Composite *me, size_t index, const Derivation *derivation, double *values);
Status part_read(Composite *me, size_t index);
/* A scalar, or the array of an element as a whole, which has slots. The place of the element must
 * stay the same: solvers compare that of its reference. */
Status part_get(Composite *me, size_t index, Type type, const Element *element, double *values);
Status part_set(Composite *me, size_t index, Type type, const Element *element,
                const double *values);
/* Sets a scalar, or the array of an element as a whole: to the values, or else to those that it has
 * now, with a change. */
Status end_set(Composite *me, const End *end, const double *values, Change change);
/* Computes what a route carries. Values that are not finite must not reach other FMUs. */
Status route_carry(Composite *me, const Route *route, const double *values, double *carried);
/* Fills the output slots of all parts. */
Status system_refresh(Composite *me);

#endif
