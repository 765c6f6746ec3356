/* Equations of the double pendulum. README.md names their sources. */

#include <math.h>

#include "model.h"

/* The symmetric inertia matrix at one angle of the elbow. */
typedef struct {
    double m11, m12, m22;
} Inertia;

/* Unlike fmin and fmax, comparisons pass a NaN on, so that the step is discarded. */
static double clip(double value, double limit) {
    return value > limit ? limit : value < -limit ? -limit : value;
}

static Inertia inertia_at(const Reals *r, double cosine) {
    return (Inertia){r->P1 + 2.0 * r->P2 * cosine, r->P3 + r->P2 * cosine, r->P6};
}

static double determinant(Inertia m) {
    return m.m11 * m.m22 - m.m12 * m.m12;
}

static void solve(Inertia m, double f1, double f2, double *x1, double *x2) {
    const double d = determinant(m);
    *x1 = (m.m22 * f1 - m.m12 * f2) / d;
    *x2 = (m.m11 * f2 - m.m12 * f1) / d;
}

static double friction(double b, double cf, double v_c, double velocity) {
    return b * velocity + cf * tanh(velocity / v_c);
}

static double friction_slope(double b, double cf, double v_c, double velocity) {
    const double slip = tanh(velocity / v_c);
    return b + cf * (1.0 - slip * slip) / v_c;
}

/* The determinant is concave in cos(q2), so it is least where the arm is straight or folded. */
const char *model_constants(const Reals *r, const int32_t *, Constants *k) {
    k->least_determinant =
        fmin(determinant(inertia_at(r, 1.0)), determinant(inertia_at(r, -1.0)));
    if (!(r->P6 > 0.0) || !(k->least_determinant > 0.0)) {
        return "P1, P2, P3 and P6 must give a positive definite inertia matrix at every q2";
    }
    if (!(r->v_c > 0.0)) {
        return "v_c must be positive";
    }
    if (!(r->b1 >= 0.0) || !(r->b2 >= 0.0) || !(r->cf1 >= 0.0) || !(r->cf2 >= 0.0)) {
        return "b1, b2, cf1 and cf2 must not be negative";
    }
    if (!(r->tau_max1 >= 0.0) || !(r->tau_max2 >= 0.0) || !(r->q_dot_max >= 0.0)) {
        return "tau_max1, tau_max2 and q_dot_max must not be negative";
    }
    return NULL;
}

void model_initial_state(Reals *r) {
    r->q1 = r->q1_0;
    r->q1_dot = r->q1_dot_0;
    r->q2 = r->q2_0;
    r->q2_dot = r->q2_dot_0;
}

void model_derivatives(const Reals *r, const Constants *, const double *state,
                       double *derivative) {
    const double v1 = state[1];
    const double v2 = state[3];
    const double coriolis = r->P2 * sin(state[2]);
    const double gravity2 = r->P5 * sin(state[0] + state[2]);
    const double gravity1 = r->P4 * sin(state[0]) + gravity2;
    const double f1 = clip(r->tau1, r->tau_max1) + coriolis * (2.0 * v1 * v2 + v2 * v2) - gravity1 -
                      friction(r->b1, r->cf1, r->v_c, v1);
    const double f2 = clip(r->tau2, r->tau_max2) - coriolis * v1 * v1 - gravity2 -
                      friction(r->b2, r->cf2, r->v_c, v2);

    derivative[0] = v1;
    derivative[2] = v2;
    solve(inertia_at(r, cos(state[2])), f1, f2, &derivative[1], &derivative[3]);
}

void model_limit_state(const Reals *r, double *state) {
    state[1] = clip(state[1], r->q_dot_max);
    state[3] = clip(state[3], r->q_dot_max);
}

/* All outputs are states. */
void model_outputs(Reals *, const Constants *) {}

/* M d(q_ddot) = d(f) - d(M) q_ddot, with the accelerations in r up to date. */
void model_tangent(const Reals *r, const Constants *, Reals *d) {
    const double v1 = r->q1_dot;
    const double v2 = r->q2_dot;
    const double coriolis = r->P2 * sin(r->q2);
    const double d_coriolis = r->P2 * cos(r->q2) * d->q2;
    const double d_gravity2 = r->P5 * cos(r->q1 + r->q2) * (d->q1 + d->q2);
    const double d_gravity1 = r->P4 * cos(r->q1) * d->q1 + d_gravity2;
    const double d_tau1 = fabs(r->tau1) > r->tau_max1 ? 0.0 : d->tau1;
    const double d_tau2 = fabs(r->tau2) > r->tau_max2 ? 0.0 : d->tau2;
    const double d_inertia = -coriolis * d->q2; /* of m12; the one of m11 is twice as large */
    const double d_f1 = d_tau1 + d_coriolis * (2.0 * v1 * v2 + v2 * v2) +
                        2.0 * coriolis * (v2 * d->q1_dot + (v1 + v2) * d->q2_dot) - d_gravity1 -
                        friction_slope(r->b1, r->cf1, r->v_c, v1) * d->q1_dot;
    const double d_f2 = d_tau2 - d_coriolis * v1 * v1 - 2.0 * coriolis * v1 * d->q1_dot -
                        d_gravity2 - friction_slope(r->b2, r->cf2, r->v_c, v2) * d->q2_dot;

    solve(inertia_at(r, cos(r->q2)), d_f1 - d_inertia * (2.0 * r->q1_ddot + r->q2_ddot),
          d_f2 - d_inertia * r->q1_ddot, &d->q1_ddot, &d->q2_ddot);
}
