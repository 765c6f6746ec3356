/* Variables and constants of the house.
 * The position of a Real in the list is its value reference. */

#ifndef CONFIG_H
#define CONFIG_H

#define MODEL_IDENTIFIER House

#define TOKEN_FMI2 "{6f0c2c0e-9b1e-4f5f-8c43-6b8a5a3b7d21}"
#define TOKEN_FMI3 "{b7a3c1d4-52f7-4b0a-9e0c-3f1de27c8a96}"

/* Outputs from T_air on depend directly on inputs. The derivatives must come last, in the order of
 * the states; the derivative of the energy E is the power P. */
#define MODEL_REALS(REAL)                            \
    REAL(time, CALCULATED, 0.0)                      \
    REAL(T_m, CALCULATED, 293.15)                    \
    REAL(T_w, CALCULATED, 303.15)                    \
    REAL(E, CALCULATED, 0.0)                         \
    REAL(T_out, INPUT, 278.15)                       \
    REAL(I_sol, INPUT, 0.0)                          \
    REAL(Q_int, INPUT, 300.0)                        \
    REAL(u, INPUT, 0.0)                              \
    REAL(A_f, FIXED, 150.0)                          \
    REAL(a_m, FIXED, 2.5)                            \
    REAL(c_m, FIXED, 165000.0)                       \
    REAL(H_op, FIXED, 100.0)                         \
    REAL(H_w, FIXED, 40.0)                           \
    REAL(H_ve, TUNABLE, 60.0)                        \
    REAL(A_sol, FIXED, 8.0)                          \
    REAL(UA, FIXED, 400.0)                           \
    REAL(C_w, FIXED, 2.5e6)                          \
    REAL(P_max, FIXED, 3000.0)                       \
    REAL(u_min, FIXED, 0.2)                          \
    REAL(T_w_max, FIXED, 328.15)                     \
    REAL(cop_factor, FIXED, 0.85)                    \
    REAL(T_m_0, FIXED, 293.15)                       \
    REAL(T_w_0, FIXED, 303.15)                       \
    REAL(max_step, FIXED, 60.0)                      \
    REAL(T_air, CALCULATED, 293.15)                  \
    REAL(T_op, CALCULATED, 293.15)                   \
    REAL(Q_hp, CALCULATED, 0.0)                      \
    REAL(Q_em, CALCULATED, 0.0)                      \
    REAL(COP, CALCULATED, 0.0)                       \
    REAL(der_T_m, CALCULATED, 0.0)                   \
    REAL(der_T_w, CALCULATED, 0.0)                   \
    REAL(P, CALCULATED, 0.0)

/* name, kind, start, number of items */
#define MODEL_ENUMERATIONS(ENUMERATION)              \
    ENUMERATION(solver, FIXED, 2, 2)

#define FIRST_STATE VR_T_m
#define NUMBER_OF_STATES 3
#define MODEL_ORDER 1
#define FIRST_FEEDTHROUGH VR_T_air

/* Values that depend on parameters only. Conductances are in W/K. */
typedef struct {
    double air_to_surface;
    double surface_to_mass;
    double mass_to_outside;
    double mass_capacity;    /* J/K */
    double mass_share;       /* of the gains that do not go to the air */
    double surface_share;
    double air_sum;          /* of all conductances at the node */
    double surface_sum;
    double determinant;      /* of the balances of air and surface, W^2/K^2 */
} Constants;

#endif
