/* The methods of integration. All take one step from one state, so that nothing else has to be
 * saved with it. */

#ifndef FMUGYM_METHODS_H
#define FMUGYM_METHODS_H

#include "fmi/fmi.h"
#include "model_exchange/clock.h"

struct Access;
struct Solver;

typedef struct Method {
    const char *name;
    size_t stages;      /* arrays of states that it uses */
    double order;       /* of the estimate of the error; 0 if it makes none */
    size_t last;        /* the stage that is the rates at the end, or 0 if none is */
    bool needs_jacobian;
    /* Computes next at this time from x and the rates, and the norm of the error: above 1, the
     * step is too large. */
    Status (*step)(struct Solver *me, double end, double *error);
    /* How much longer the step is than that in which the rates change by the states; for a method whose
     * steps stiffness makes short, otherwise NULL. */
    double (*stiffness)(struct Solver *me, double end);
    /* The state at a fraction of the step from the time of the memory to the end. */
    Status (*between)(struct Solver *me, double end, double fraction, double *x);
} Method;

extern const Method euler, rk4, dormand_prince, rosenbrock;
/* No method: the FMU does its steps by itself, and wants events between them. */
extern const Method by_fmu;

/* NULL if there is none of this name. */
const Method *method_of(const char *name);

/* How a pool solves the equations of its instances. */
typedef struct Solving {
    const Method *method;
    double tolerance; /* relative */
    double max_step;  /* infinite for none */
    size_t states, indicators;
    bool completes; /* whether the FMU wants to know of complete steps */
    /* one for each state; NULL if the FMU gives no directional derivatives */
    const uint32_t *state_references, *rate_references;
    const Clock *clocks;
    const Clocked *clocked;
    size_t number_of_clocks, number_of_clocked;
} Solving;

#endif
