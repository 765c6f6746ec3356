/* Variables and constants of the pendulum.
 * The position of a Real in the list is its value reference. */

#ifndef CONFIG_H
#define CONFIG_H

#define MODEL_IDENTIFIER Pendulum

#define TOKEN_FMI1 "{8d2ae259-345d-46e8-96f9-5bd40556dca3}"
#define TOKEN_FMI2 "{4fa4f759-3814-4d94-b527-5a8486343db5}"
#define TOKEN_FMI3 "{31777366-07b4-41cc-946c-e36470f426ed}"

/* The angle theta is 0 upright, the angle q is 0 hanging. Both are positive counter-clockwise. The
 * accelerations must come last, in the order of the states. */
#define MODEL_REALS(REAL)                            \
    REAL(time, CALCULATED, 0.0)                      \
    REAL(theta, CALCULATED, 0.0)                     \
    REAL(theta_dot, CALCULATED, 0.0)                 \
    REAL(q, CALCULATED, 0.0)                         \
    REAL(q_dot, CALCULATED, 0.0)                     \
    REAL(tau, INPUT, 0.0)                            \
    REAL(m, FIXED, 0.06)                             \
    REAL(l, FIXED, 0.1)                              \
    REAL(b, TUNABLE, 4e-4)                           \
    REAL(c, TUNABLE, 0.0)                            \
    REAL(v_c, FIXED, 0.05)                           \
    REAL(g, FIXED, 9.81)                             \
    REAL(tau_max, FIXED, 0.15)                       \
    REAL(theta_dot_max, FIXED, 50.0)                 \
    REAL(theta_0, FIXED, 0.0)                        \
    REAL(theta_dot_0, FIXED, 0.0)                    \
    REAL(q_0, FIXED, 3.141592653589793)              \
    REAL(q_dot_0, FIXED, 0.0)                        \
    REAL(max_step, FIXED, 0.001)                     \
    REAL(theta_ddot, CALCULATED, 0.0)

/* name, kind, start, number of items */
#define MODEL_ENUMERATIONS(ENUMERATION)              \
    ENUMERATION(body, FIXED, 1, 2)                   \
    ENUMERATION(solver, FIXED, 3, 3)

#define FIRST_STATE VR_theta
#define NUMBER_OF_STATES 2
#define MODEL_ORDER 2

enum { POINT_MASS = 1, UNIFORM_ROD = 2 };

/* Values that depend on parameters only. */
typedef struct {
    double gravity_gain; /* 1/s^2, theta_ddot per sin(theta) */
    double torque_gain;  /* 1/(kg m^2), theta_ddot per torque */
} Constants;

#endif
