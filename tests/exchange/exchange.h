/* Models for model exchange, and what fmi1.c, fmi2.c and fmi3.c ask of them.

   core.c holds the rules of the standard: a call in the wrong mode is an Error. A model is one of
   the other files. Its variables are numbered by their value references: first the states, then
   their derivatives. */

#pragma once

#include <math.h>
#include <stdbool.h>
#include <stddef.h>

enum { OK, WARNING, DISCARD, ERROR };
enum { INSTANTIATED, INITIALIZING, EVENT, CONTINUOUS, STEPPING, TERMINATED };
enum { MOST = 32 };

#ifndef EARLY
#define EARLY INFINITY
#endif

#ifndef LONGEST
#define LONGEST INFINITY
#endif

typedef struct {
    double v[MOST]; /* the variables */
    double time;
    double completed; /* the time of the last complete step or event */
    double next_event;
    double stop; /* when the model asks to stop */
    int mode;
    int status;        /* of computing the derivatives */
    bool exchange;     /* by model exchange, not co-simulation */
    bool stops;        /* whether it asks to stop now */
    bool again;        /* whether the discrete states need another update */
    bool wants_event;  /* after a complete step */
    char name[64];
    void *logger, *environment;
} Model;

/* Every model has these. */
extern const size_t STATES, INDICATORS;
void model_start(Model *me);      /* start values */
void model_initialize(Model *me); /* what follows from them */
void model_rates(Model *me);      /* computes derivatives and outputs */
void model_indicators(const Model *me, double *z);
void model_event(Model *me);      /* updates the discrete states */
void model_complete(Model *me);   /* after a step */
double model_partial(const Model *me, size_t unknown, size_t known);

Model *core_new(const char *name, bool exchange, void *logger, void *environment);
int core_reset(Model *me);
int core_enter_initialization(Model *me, double time);
int core_exit_initialization(Model *me);
int core_enter_events(Model *me);
int core_update(Model *me);
int core_enter_continuous(Model *me);
int core_complete(Model *me);
int core_set_time(Model *me, double time);
int core_set_states(Model *me, const double *x, size_t count);
int core_get_states(Model *me, double *x, size_t count);
int core_rates(Model *me, double *rates, size_t count);
int core_indicators(Model *me, double *z, size_t count);
int core_nominals(Model *me, double *x, size_t count);
int core_get(Model *me, const unsigned *references, size_t count, double *values);
int core_set(Model *me, const unsigned *references, size_t count, const double *values);
int core_do_step(Model *me, double time, double step);
int core_get_state(Model *me, void **state);
int core_set_state(Model *me, const void *state);
int core_free_state(void **state);
int core_to_bytes(const void *state, char *bytes, size_t size);
int core_from_bytes(const char *bytes, size_t size, void **state);
int core_differentiate(Model *me, const unsigned *unknowns, size_t count, const unsigned *knowns,
                       size_t number_of_knowns, const double *seed, double *result);
