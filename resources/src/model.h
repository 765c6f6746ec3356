/* What a model provides to the FMI functions: its variables (config.h) and its equations (model.c).
 *
 * The states are contiguous Reals, and the last Reals are their derivatives. In a model with
 * MODEL_ORDER 2, the states come in pairs of a position and its velocity, and only the velocities
 * have derivatives of their own. In a model with MODEL_ORDER 1, every state has one. Outputs that
 * depend directly on inputs stand before the derivatives, from FIRST_FEEDTHROUGH on, if the model
 * defines that. Every model has the Reals "time" and "max_step" and the enumeration "solver". All
 * members of Constants are doubles. */

#ifndef MODEL_H
#define MODEL_H

#include <stddef.h>
#include <stdint.h>

#include "config.h"

#define REAL_REFERENCE(name, kind, start) VR_##name,
#define ENUMERATION_INDEX(name, kind, start, items) ENUM_##name,
#define REAL_MEMBER(name, kind, start) double name;

enum { MODEL_REALS(REAL_REFERENCE) NUMBER_OF_REALS };
enum { MODEL_ENUMERATIONS(ENUMERATION_INDEX) NUMBER_OF_ENUMERATIONS };
enum {
    NUMBER_OF_DERIVATIVES = NUMBER_OF_STATES / MODEL_ORDER,
    FIRST_DERIVATIVE = NUMBER_OF_REALS - NUMBER_OF_DERIVATIVES,
#ifdef FIRST_FEEDTHROUGH
    FIRST_ON_DEMAND = FIRST_FEEDTHROUGH,
#else
    FIRST_ON_DEMAND = FIRST_DERIVATIVE,
#endif
    HAS_FEEDTHROUGH = FIRST_ON_DEMAND < FIRST_DERIVATIVE
};

/* All Reals of an instance: by name for the equations, by value reference for FMI. */
typedef union {
    struct {
        MODEL_REALS(REAL_MEMBER)
    };
    double values[NUMBER_OF_REALS];
} Reals;

/* Computes the constants. Returns NULL, or a text that says what is wrong with the parameters. */
const char *model_constants(const Reals *r, const int32_t *enumerations, Constants *k);

/* Sets the states from the start values. */
void model_initial_state(Reals *r);

/* Computes the derivatives of a state, which may differ from the one in r. */
void model_derivatives(const Reals *r, const Constants *k, const double *state,
                       double *derivative);

/* Applies the limits of the state. The solvers call it after each internal step. */
void model_limit_state(const Reals *r, double *state);

/* Computes the outputs that are not states. */
void model_outputs(Reals *r, const Constants *k);

/* Differentiates outputs and derivatives in a direction. The states and inputs of d hold the
 * direction; the results go to the other members of d. */
void model_tangent(const Reals *r, const Constants *k, Reals *d);

#endif
