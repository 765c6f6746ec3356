/* Equations of the pendulum. README.md names their sources.
 *
 * The floating-point operations have the order of Gymnasium's Pendulum-v1, so that its parameters
 * give the same trajectories bit for bit. */

#include <math.h>

#include "model.h"

static const double PI = 3.14159265358979323846;

/* Unlike fmin and fmax, comparisons pass a NaN on, so that the step is discarded. */
static double clip(double value, double limit) {
    return value > limit ? limit : value < -limit ? -limit : value;
}

const char *model_constants(const Reals *r, const int32_t *enumerations, Constants *k) {
    if (!(r->m > 0.0) || !(r->l > 0.0) || !(r->v_c > 0.0)) {
        return "m, l and v_c must be positive";
    }
    if (!(r->b >= 0.0) || !(r->c >= 0.0) || !(r->tau_max >= 0.0) || !(r->theta_dot_max >= 0.0)) {
        return "b, c, tau_max and theta_dot_max must not be negative";
    }
    if (enumerations[ENUM_body] == UNIFORM_ROD) {
        k->gravity_gain = 3.0 * r->g / (2.0 * r->l);
        k->torque_gain = 3.0 / (r->m * (r->l * r->l));
    } else {
        k->gravity_gain = r->g / r->l;
        k->torque_gain = 1.0 / (r->m * (r->l * r->l));
    }
    return NULL;
}

void model_initial_state(Reals *r) {
    r->theta = r->theta_0 + (r->q_0 - PI); /* adds an exact 0 if q_0 is pi */
    r->theta_dot = r->theta_dot_0 + r->q_dot_0;
}

void model_derivatives(const Reals *r, const Constants *k, const double *state,
                       double *derivative) {
    const double theta_dot = state[1];
    double torque = clip(r->tau, r->tau_max) - r->b * theta_dot;

    if (r->c != 0.0) {
        torque -= r->c * tanh(theta_dot / r->v_c);
    }
    derivative[0] = theta_dot;
    derivative[1] = k->gravity_gain * sin(state[0]) + k->torque_gain * torque;
}

void model_limit_state(const Reals *r, double *state) {
    state[1] = clip(state[1], r->theta_dot_max);
}

void model_outputs(Reals *r, const Constants *) {
    r->q = r->theta + PI;
    r->q_dot = r->theta_dot;
}

void model_tangent(const Reals *r, const Constants *k, Reals *d) {
    const double d_tau = fabs(r->tau) > r->tau_max ? 0.0 : d->tau;
    const double slip = tanh(r->theta_dot / r->v_c);
    const double damping = r->b + r->c * (1.0 - slip * slip) / r->v_c;

    d->theta_ddot = k->gravity_gain * cos(r->theta) * d->theta +
                    k->torque_gain * (d_tau - damping * d->theta_dot);
    d->q = d->theta;
    d->q_dot = d->theta_dot;
}
