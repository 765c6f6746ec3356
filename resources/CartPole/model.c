/* Equations of the cart-pole. README.md names their sources.
 *
 * The floating-point operations have the order of Gymnasium's CartPole-v1. A balanced cart-pole is
 * unstable, so that the smallest difference in rounding would grow. */

#include <math.h>

#include "model.h"

static const double PI = 3.14159265358979323846;

/* The pole of the default pole_type: a wooden cylinder with a small body at its end. */
static const double CYLINDER_DENSITY = 900.0; /* kg/m^3 */
static const double CYLINDER_RADIUS = 0.025;  /* m */
static const double BODY_INERTIA = 0.001;     /* kg m^2, of the body about its own centre */

static void set_uniform_rod(const Reals *r, Constants *k) {
    k->pole_mass = r->m_pole;
    k->pole_centre = r->pole_length / 2.0;
    k->inertia_ratio = 4.0 / 3.0;
}

static void set_cylinder_with_point_mass(const Reals *r, Constants *k) {
    const double length = r->pole_length;
    const double radius2 = CYLINDER_RADIUS * CYLINDER_RADIUS;
    const double cylinder = CYLINDER_DENSITY * PI * radius2 * length;
    const double cylinder_inertia = cylinder * (radius2 / 4.0 + length * length / 3.0);
    const double inertia = cylinder_inertia + r->m_pole * length * length + BODY_INERTIA;

    k->pole_mass = cylinder + r->m_pole;
    k->pole_centre = (cylinder / 2.0 + r->m_pole) * length / k->pole_mass;
    k->inertia_ratio = inertia / (k->pole_mass * k->pole_centre * k->pole_centre);
}

const char *model_constants(const Reals *r, const int32_t *enumerations, Constants *k) {
    if (!(r->m_cart > 0.0) || !(r->m_pole > 0.0) || !(r->pole_length > 0.0)) {
        return "m_cart, m_pole and pole_length must be positive";
    }
    if (enumerations[ENUM_pole_type] == UNIFORM_ROD) {
        set_uniform_rod(r, k);
    } else {
        set_cylinder_with_point_mass(r, k);
    }
    k->total_mass = k->pole_mass + r->m_cart;
    k->polemass_length = k->pole_mass * k->pole_centre;
    return NULL;
}

void model_initial_state(Reals *r) {
    r->x = r->x_0;
    r->x_dot = r->x_dot_0;
    r->phi = r->phi_0 + (PI / 2.0 - r->theta_0); /* adds an exact 0 if theta_0 is pi / 2 */
    r->phi_dot = r->phi_dot_0 - r->theta_dot_0;
}

void model_derivatives(const Reals *r, const Constants *k, const double *state,
                       double *derivative) {
    const double sine = sin(state[2]);
    const double cosine = cos(state[2]);
    const double phi_dot = state[3];
    const double temp =
        (r->f + k->polemass_length * (phi_dot * phi_dot) * sine) / k->total_mass;
    const double phi_ddot =
        (r->g * sine - cosine * temp) /
        (k->pole_centre * (k->inertia_ratio - k->pole_mass * (cosine * cosine) / k->total_mass));

    derivative[0] = state[1];
    derivative[1] = temp - k->polemass_length * phi_ddot * cosine / k->total_mass;
    derivative[2] = phi_dot;
    derivative[3] = phi_ddot;
}

/* The cart-pole has no limits. */
void model_limit_state(const Reals *, double *) {}

void model_outputs(Reals *r, const Constants *) {
    r->theta = PI / 2.0 - r->phi;
    r->theta_dot = 0.0 - r->phi_dot; /* unlike -phi_dot no negative zero at rest */
}

void model_tangent(const Reals *r, const Constants *k, Reals *d) {
    const double sine = sin(r->phi);
    const double cosine = cos(r->phi);
    const double pull = k->polemass_length * r->phi_dot;
    const double temp = (r->f + pull * r->phi_dot * sine) / k->total_mass;
    const double d_temp =
        (d->f + pull * (2.0 * sine * d->phi_dot + r->phi_dot * cosine * d->phi)) / k->total_mass;
    const double coupling = k->pole_mass * cosine / k->total_mass;
    const double divisor = k->pole_centre * (k->inertia_ratio - coupling * cosine);
    const double d_divisor = k->pole_centre * 2.0 * coupling * sine * d->phi;
    const double phi_ddot = (r->g * sine - cosine * temp) / divisor;

    const double d_dividend = (r->g * cosine + sine * temp) * d->phi - cosine * d_temp;
    const double d_phi_ddot = (d_dividend - phi_ddot * d_divisor) / divisor;
    const double d_reaction = cosine * d_phi_ddot - phi_ddot * sine * d->phi;

    d->phi_ddot = d_phi_ddot;
    d->x_ddot = d_temp - k->polemass_length * d_reaction / k->total_mass;
    d->theta = -d->phi;
    d->theta_dot = -d->phi_dot;
}
