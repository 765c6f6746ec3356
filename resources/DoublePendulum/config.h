/* Variables and constants of the double pendulum.
 * The position of a Real in the list is its value reference. */

#ifndef CONFIG_H
#define CONFIG_H

#define MODEL_IDENTIFIER DoublePendulum

#define TOKEN_FMI2 "{0b7c1c8e-0a52-4a39-9d7e-6a4f1c6d2f53}"
#define TOKEN_FMI3 "{c41f6ad3-3c07-4a0b-8a55-2be0f9d4b6e8}"

/* The shoulder's angle q1 is 0 when the arm hangs. The elbow's angle q2 is relative to the first
 * link. Both are positive counter-clockwise. The accelerations must come last, in the order of the
 * states. */
#define MODEL_REALS(REAL)                            \
    REAL(time, CALCULATED, 0.0)                      \
    REAL(q1, CALCULATED, 0.0)                        \
    REAL(q1_dot, CALCULATED, 0.0)                    \
    REAL(q2, CALCULATED, 0.0)                        \
    REAL(q2_dot, CALCULATED, 0.0)                    \
    REAL(tau1, INPUT, 0.0)                           \
    REAL(tau2, INPUT, 0.0)                           \
    REAL(P1, FIXED, 7.466e-4)                        \
    REAL(P2, FIXED, 1.489e-4)                        \
    REAL(P3, FIXED, 2.160e-4)                        \
    REAL(P6, FIXED, 2.122e-4)                        \
    REAL(P4, FIXED, 0.09642)                         \
    REAL(P5, FIXED, 0.03400)                         \
    REAL(b1, TUNABLE, 3.20e-4)                       \
    REAL(b2, TUNABLE, 1.31e-4)                       \
    REAL(cf1, TUNABLE, 2.29e-3)                      \
    REAL(cf2, TUNABLE, 3.15e-3)                      \
    REAL(v_c, FIXED, 0.05)                           \
    REAL(tau_max1, FIXED, 0.15)                      \
    REAL(tau_max2, FIXED, 0.15)                      \
    REAL(q_dot_max, FIXED, 50.0)                     \
    REAL(q1_0, FIXED, 0.0)                           \
    REAL(q2_0, FIXED, 0.0)                           \
    REAL(q1_dot_0, FIXED, 0.0)                       \
    REAL(q2_dot_0, FIXED, 0.0)                       \
    REAL(max_step, FIXED, 0.001)                     \
    REAL(q1_ddot, CALCULATED, 0.0)                   \
    REAL(q2_ddot, CALCULATED, 0.0)

/* name, kind, start, number of items */
#define MODEL_ENUMERATIONS(ENUMERATION)              \
    ENUMERATION(solver, FIXED, 3, 3)

#define FIRST_STATE VR_q1
#define NUMBER_OF_STATES 4
#define MODEL_ORDER 2

/* Values that depend on parameters only. */
typedef struct {
    double least_determinant; /* kg^2 m^4, of the inertia matrix, over all angles */
} Constants;

#endif
