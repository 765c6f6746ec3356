/* What a model provides to the FMI functions: its variables (config.h) and its equations (model.c).
 *
 * Models are second-order systems: the states are contiguous Reals that come in pairs of a position
 * and its velocity, and the last Reals are the accelerations, one per pair. Every model has the
 * Reals "time" and "max_step" and the enumeration "solver"; its Constants are doubles only. */

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
    NUMBER_OF_ACCELERATIONS = NUMBER_OF_STATES / 2,
    FIRST_ACCELERATION = NUMBER_OF_REALS - NUMBER_OF_ACCELERATIONS
};

/* All Reals of an instance: by name for the equations, by value reference for FMI. */
typedef union {
    struct {
        MODEL_REALS(REAL_MEMBER)
    };
    double values[NUMBER_OF_REALS];
} Reals;

/* Computes the constants; returns NULL, or what is wrong with the parameters. */
const char *model_constants(const Reals *r, const int32_t *enumerations, Constants *k);

/* Sets the states from the start values. */
void model_initial_state(Reals *r);

/* Computes the derivatives of the given state, which need not be the one in r. */
void model_derivatives(const Reals *r, const Constants *k, const double *state,
                       double *derivative);

/* Applies the limits of the state, after each internal step. */
void model_limit_state(const Reals *r, double *state);

/* Computes the outputs that are not states. */
void model_outputs(Reals *r);

/* Differentiates outputs and accelerations in the direction d, given in its states and inputs. */
void model_tangent(const Reals *r, const Constants *k, Reals *d);

#endif
