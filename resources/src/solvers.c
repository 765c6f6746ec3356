#include "solvers.h"

/* Keeps large methods out of the loop of the explicit Euler method, whose speed matters most. */
#define APART [[gnu::noinline]]

static void step_explicit_euler(const Reals *r, const Constants *k, double step, double *state) {
    double derivative[NUMBER_OF_STATES];

    model_derivatives(r, k, state, derivative);
    for (int i = 0; i < NUMBER_OF_STATES; i++) {
        state[i] += step * derivative[i];
    }
}

/* Advances the velocities first, then the positions with the new, limited velocities. */
APART static void step_semi_implicit_euler(const Reals *r, const Constants *k, double step,
                                           double *state) {
    double derivative[NUMBER_OF_STATES];

    model_derivatives(r, k, state, derivative);
    for (int i = 1; i < NUMBER_OF_STATES; i += 2) {
        state[i] += step * derivative[i];
    }
    model_limit_state(r, state);
    for (int i = 0; i < NUMBER_OF_STATES; i += 2) {
        state[i] += step * state[i + 1];
    }
}

static void move(const double *from, double step, const double *derivative, double *to) {
    for (int i = 0; i < NUMBER_OF_STATES; i++) {
        to[i] = from[i] + step * derivative[i];
    }
}

/* The classical Runge-Kutta method of order 4. */
APART static void step_rk4(const Reals *r, const Constants *k, double step, double *state) {
    double k1[NUMBER_OF_STATES];
    double k2[NUMBER_OF_STATES];
    double k3[NUMBER_OF_STATES];
    double k4[NUMBER_OF_STATES];
    double stage[NUMBER_OF_STATES];

    model_derivatives(r, k, state, k1);
    move(state, step / 2.0, k1, stage);
    model_derivatives(r, k, stage, k2);
    move(state, step / 2.0, k2, stage);
    model_derivatives(r, k, stage, k3);
    move(state, step, k3, stage);
    model_derivatives(r, k, stage, k4);
    for (int i = 0; i < NUMBER_OF_STATES; i++) {
        state[i] += step / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
    }
}

APART static void integrate_otherwise(const Reals *r, const Constants *k, int32_t solver,
                                      double step, int32_t number, double *state) {
    for (int32_t i = 0; i < number; i++) {
        if (MODEL_ORDER == 2 && solver == SEMI_IMPLICIT_EULER) {
            step_semi_implicit_euler(r, k, step, state);
        } else {
            step_rk4(r, k, step, state);
        }
        model_limit_state(r, state);
    }
}

void integrate(const Reals *r, const Constants *k, int32_t solver, double step, int32_t number,
               double *state) {
    if (solver != EXPLICIT_EULER) {
        integrate_otherwise(r, k, solver, step, number, state);
        return;
    }
    for (int32_t i = 0; i < number; i++) {
        step_explicit_euler(r, k, step, state);
        model_limit_state(r, state);
    }
}
