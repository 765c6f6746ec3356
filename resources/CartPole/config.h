/* Variables and constants of the cart-pole.
 * The position of a Real in the list is its value reference. */

#ifndef CONFIG_H
#define CONFIG_H

#define MODEL_IDENTIFIER CartPole

#define TOKEN_FMI1 "{659ce8ff-a442-45d1-b30b-1f266f8d8d27}"
#define TOKEN_FMI2 "{aa23bbe0-b1da-43cf-9a66-77de622fbc1f}"
#define TOKEN_FMI3 "{30eb7979-8b48-49c1-b153-c19cd64462fd}"

/* Angles named phi count from the upright pole, positive towards +x. Angles named theta count from
 * the positive x-axis, counter-clockwise. The accelerations must come last, in the order of the
 * states. */
#define MODEL_REALS(REAL)                            \
    REAL(time, CALCULATED, 0.0)                      \
    REAL(x, CALCULATED, 0.0)                         \
    REAL(x_dot, CALCULATED, 0.0)                     \
    REAL(phi, CALCULATED, 0.0)                       \
    REAL(phi_dot, CALCULATED, 0.0)                   \
    REAL(theta, CALCULATED, 0.0)                     \
    REAL(theta_dot, CALCULATED, 0.0)                 \
    REAL(f, INPUT, 0.0)                              \
    REAL(m_cart, FIXED, 10.0)                        \
    REAL(m_pole, FIXED, 1.0)                         \
    REAL(theta_0, FIXED, 1.4835298641951802)         \
    REAL(theta_dot_0, FIXED, 0.0)                    \
    REAL(x_0, FIXED, 0.0)                            \
    REAL(x_dot_0, FIXED, 0.0)                        \
    REAL(phi_0, FIXED, 0.0)                          \
    REAL(phi_dot_0, FIXED, 0.0)                      \
    REAL(g, FIXED, 9.81)                             \
    REAL(pole_length, FIXED, 1.0)                    \
    REAL(max_step, FIXED, 0.001)                     \
    REAL(x_ddot, CALCULATED, 0.0)                    \
    REAL(phi_ddot, CALCULATED, 0.0)

/* name, kind, start, number of items */
#define MODEL_ENUMERATIONS(ENUMERATION)              \
    ENUMERATION(pole_type, FIXED, 1, 2)              \
    ENUMERATION(solver, FIXED, 3, 3)

#define FIRST_STATE VR_x
#define NUMBER_OF_STATES 4
#define MODEL_ORDER 2

enum { CYLINDER_WITH_POINT_MASS = 1, UNIFORM_ROD = 2 };

/* Values that depend on parameters only. */
typedef struct {
    double pole_mass;       /* kg */
    double total_mass;      /* kg, cart and pole */
    double pole_centre;     /* m, from the pivot to the pole's centre of mass */
    double polemass_length; /* kg m, pole_mass * pole_centre */
    double inertia_ratio;   /* inertia about the pivot / (pole_mass * pole_centre^2) */
} Constants;

#endif
