/* Equations of the house. README.md names their sources. */

#include <math.h>

#include "model.h"

/* ISO 13790: 7.2.2.2, 12.2.2 and C.3. */
static const double SURFACE_PER_FLOOR = 4.5;     /* A_tot / A_f */
static const double AIR_TO_SURFACE = 3.45;       /* W/(m^2 K) */
static const double SURFACE_TO_MASS = 9.1;       /* W/(m^2 K) */
static const double OPERATIVE_SHARE_OF_AIR = 0.3;

/* The regression of the COP holds from 15 K on and falls until 90 K. */
static const double LEAST_LIFT = 15.0;
static const double LARGEST_LIFT = 90.0;

/* The heat pump reduces its power over the last kelvins below the largest temperature of the water. */
static const double THROTTLE_RANGE = 2.0;

/* What a state and the inputs give. Temperatures in K, heat flows and power in W. */
typedef struct {
    double air, surface; /* temperatures */
    double emission;     /* from the water to the air */
    double power;        /* electrical */
    double cop;
} Balance;

/* Unlike fmin and fmax, comparisons pass a NaN on, so that the step is discarded. */
static double clip(double value, double least, double largest) {
    return value < least ? least : value > largest ? largest : value;
}

const char *model_constants(const Reals *r, const int32_t *, Constants *k) {
    const double surface_area = SURFACE_PER_FLOOR * r->A_f;
    const double mass_area = r->a_m * r->A_f;

    if (!(r->A_f > 0.0) || !(r->c_m > 0.0) || !(r->C_w > 0.0) || !(r->UA > 0.0)) {
        return "A_f, c_m, C_w and UA must be positive";
    }
    if (!(r->a_m > 0.0) || !(r->a_m < SURFACE_PER_FLOOR)) {
        return "a_m must lie between 0 and 4.5";
    }
    if (!(r->H_w >= 0.0) || !(r->H_ve >= 0.0) || !(r->A_sol >= 0.0) || !(r->P_max >= 0.0)) {
        return "H_w, H_ve, A_sol and P_max must not be negative";
    }
    if (!(r->u_min >= 0.0) || !(r->u_min <= 1.0) || !(r->cop_factor > 0.0)) {
        return "u_min must lie between 0 and 1, and cop_factor must be positive";
    }
    k->air_to_surface = AIR_TO_SURFACE * surface_area;
    k->surface_to_mass = SURFACE_TO_MASS * mass_area;
    if (!(r->H_op > 0.0) || !(r->H_op < k->surface_to_mass)) {
        return "H_op must be positive and less than 9.1 * a_m * A_f";
    }
    k->mass_to_outside = 1.0 / (1.0 / r->H_op - 1.0 / k->surface_to_mass);
    k->mass_capacity = r->c_m * r->A_f;
    k->mass_share = mass_area / surface_area;
    k->surface_share = 1.0 - k->mass_share - r->H_w / (SURFACE_TO_MASS * surface_area);
    k->air_sum = r->H_ve + k->air_to_surface + r->UA;
    k->surface_sum = k->surface_to_mass + r->H_w + k->air_to_surface;
    k->determinant = k->air_sum * k->surface_sum - k->air_to_surface * k->air_to_surface;
    return NULL;
}

void model_initial_state(Reals *r) {
    r->T_m = r->T_m_0;
    r->T_w = r->T_w_0;
    r->E = 0.0;
}

/* Half of the internal gains heat the air. The other half and the sun heat surface and mass. */
static double radiant_gains(double solar, double internal, double aperture) {
    return 0.5 * internal + aperture * solar;
}

static double lift(const Reals *r, double water) {
    return clip(water - r->T_out, LEAST_LIFT, LARGEST_LIFT);
}

static double cop(const Reals *r, double water) {
    const double dT = lift(r, water);
    return r->cop_factor * (6.08 - 0.09 * dT + 0.0005 * dT * dT);
}

/* Below its least part load the heat pump is off. */
static double part_load(const Reals *r) {
    return r->u < r->u_min ? 0.0 : clip(r->u, 0.0, 1.0);
}

static double throttle(const Reals *r, double water) {
    return clip((r->T_w_max - water) / THROTTLE_RANGE, 0.0, 1.0);
}

/* Solves the balances of the two nodes without capacity for the heat that flows to them from nodes
 * of known temperature and from gains. */
static void solve_nodes(const Constants *k, double to_air, double to_surface, double *air,
                        double *surface) {
    *air = (k->surface_sum * to_air + k->air_to_surface * to_surface) / k->determinant;
    *surface = (k->air_sum * to_surface + k->air_to_surface * to_air) / k->determinant;
}

static Balance balance(const Reals *r, const Constants *k, double mass, double water) {
    const double gains = radiant_gains(r->I_sol, r->Q_int, r->A_sol);
    Balance b;

    solve_nodes(k, r->H_ve * r->T_out + r->UA * water + 0.5 * r->Q_int,
                k->surface_to_mass * mass + r->H_w * r->T_out + k->surface_share * gains, &b.air,
                &b.surface);
    b.emission = r->UA * (water - b.air);
    b.power = r->P_max * part_load(r) * throttle(r, water);
    b.cop = cop(r, water);
    return b;
}

void model_derivatives(const Reals *r, const Constants *k, const double *state,
                       double *derivative) {
    const double mass = state[0];
    const double water = state[1];
    const Balance b = balance(r, k, mass, water);
    const double gains = k->mass_share * radiant_gains(r->I_sol, r->Q_int, r->A_sol);

    derivative[0] = (k->mass_to_outside * (r->T_out - mass) +
                     k->surface_to_mass * (b.surface - mass) + gains) /
                    k->mass_capacity;
    derivative[1] = (b.cop * b.power - b.emission) / r->C_w;
    derivative[2] = b.power;
}

void model_limit_state(const Reals *, double *) {}

void model_outputs(Reals *r, const Constants *k) {
    const Balance b = balance(r, k, r->T_m, r->T_w);

    r->T_air = b.air;
    r->T_op = OPERATIVE_SHARE_OF_AIR * b.air + (1.0 - OPERATIVE_SHARE_OF_AIR) * b.surface;
    r->Q_em = b.emission;
    r->Q_hp = b.cop * b.power;
    r->COP = b.cop;
}

/* Each limit lets changes through only inside of its range. */
static void heat_pump_tangent(const Reals *r, Reals *d) {
    const double dT = lift(r, r->T_w);
    const double d_lift = dT > LEAST_LIFT && dT < LARGEST_LIFT ? d->T_w - d->T_out : 0.0;
    const double room = throttle(r, r->T_w);
    const double d_throttle = room > 0.0 && room < 1.0 ? -d->T_w / THROTTLE_RANGE : 0.0;
    const double d_load = r->u >= r->u_min && r->u <= 1.0 ? d->u : 0.0;

    d->COP = r->cop_factor * (-0.09 + 0.001 * dT) * d_lift;
    d->P = r->P_max * (d_load * room + part_load(r) * d_throttle);
    d->Q_hp = d->COP * r->P + r->COP * d->P;
}

void model_tangent(const Reals *r, const Constants *k, Reals *d) {
    const double d_gains = radiant_gains(d->I_sol, d->Q_int, r->A_sol);
    double d_surface;

    heat_pump_tangent(r, d);
    solve_nodes(k, r->H_ve * d->T_out + r->UA * d->T_w + 0.5 * d->Q_int,
                k->surface_to_mass * d->T_m + r->H_w * d->T_out + k->surface_share * d_gains,
                &d->T_air, &d_surface);
    d->T_op = OPERATIVE_SHARE_OF_AIR * d->T_air + (1.0 - OPERATIVE_SHARE_OF_AIR) * d_surface;
    d->Q_em = r->UA * (d->T_w - d->T_air);
    d->der_T_m = (k->mass_to_outside * (d->T_out - d->T_m) +
                  k->surface_to_mass * (d_surface - d->T_m) + k->mass_share * d_gains) /
                 k->mass_capacity;
    d->der_T_w = (d->Q_hp - d->Q_em) / r->C_w;
}
