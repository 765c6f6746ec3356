/* Model exchange: the pool integrates the FMU's equations and handles its events. In co-simulation
 * with event mode the FMU does its steps, and the pool handles the events between them.
 *
 * Everything above sees an instance that can do steps, as in co-simulation: solved.h. */

#ifndef FMUGYM_SOLVER_H
#define FMUGYM_SOLVER_H

#include "fmi/exchange.h"
#include "fmi/fmi.h"
#include "model_exchange/methods.h"

/* One FMI version of model exchange. */
typedef struct Model {
    const Fmi *fmi;   /* of the FMU itself */
    size_t equations; /* where they are in the library's table of functions */
    /* Updates the discrete states. The events are known before, and what the FMU leaves as it is
     * stays so. */
    Status (*update)(const Library *library, void *component, Events *events);
    /* Tells the FMU that a step is complete. It may want an event, or to stop. */
    Status (*complete)(const Library *library, void *component, bool *event, bool *terminate);
    /* The derivatives of all rates by one state; NULL in FMI 1.0. */
    Status (*differentiate)(const Library *library, void *component, const uint32_t *rates,
                            size_t count, uint32_t state, double *column);
    size_t clocks; /* where the functions for clocks are in that table; 0 before FMI 3.0 */
    /* Initializes the FMU and tells the first events; NULL where it is done like in co-simulation. */
    Status (*initialize)(const Library *library, void *component, const Experiment *experiment,
                         StartValues start_values, const char **doing, Events *events);
    /* Lets the FMU step; NULL in model exchange. The FMU may return early, and may want an event
     * or to stop. */
    Status (*step)(const Library *library, void *component, double time, double size,
                   double *reached, bool *event, bool *terminate);
} Model;

typedef enum { BEFORE_EVENTS, IN_EVENTS, IN_CONTINUOUS_TIME } Mode;

/* What the solver keeps between two steps, and all that it adds to a saved state. */
typedef struct {
    double time;
    double next_event; /* the time of the next time event, infinite if there is none */
    double step;       /* the step size that an adaptive method tries next; 0 for none yet */
    int64_t mode;
    int64_t terminated; /* whether the FMU has asked to stop */
} Memory;

/* One instance. */
typedef struct Solver {
    const Model *model;
    const Equations *equations;
    const ClockFunctions *clock_functions; /* NULL before FMI 3.0 */
    /* Sets the inputs that may be set while this clock ticks. */
    Status (*set_clocked)(struct Solver *me, size_t clock);
    const Library *library;
    void *component;
    const Solving *solving;
    const Floats *floats;
    uint64_t environment; /* for messages */
    Memory memory;
    double fmu_time;       /* the time of the FMU; NaN if it must be set */
    bool is_there;         /* whether the FMU is at the time of the memory and at x */
    bool stale;            /* whether x and the nominal values must be read */
    bool knows_rates;      /* whether rates are those at x */
    bool knows_indicators; /* whether z are those at x */
    bool has_jacobian;     /* whether the method's Jacobian is that at x */
    size_t events;         /* handled in this communication step */
    size_t tries;          /* of steps in this communication step */
    size_t stiff, calm;    /* which of them were as long as stability allows, and which not */
    uint64_t looked;       /* when it last read the clock, in ns */
    size_t unseen;         /* tries until it reads the clock again */
    size_t n;              /* number of states */
    double *arrays;        /* the memory of all that follow */
    double *x, *rates;     /* at the time of the memory */
    double *next;          /* x at the end of the step that is tried */
    double *nominals;
    double *z, *next_z; /* event indicators at x, and after the step */
    double *trial;      /* for the methods: a state, errors, or the right-hand side of a stage */
    double *found;      /* a state where an event is looked for; for the methods: rates */
    double *low_z, *found_z; /* while an event is located */
    double *stages;     /* n for each stage of the method */
    double *jacobian, *matrix, *slope; /* for methods that need them */
    uint32_t *order; /* of the rows of the matrix */
    Ticks *ticks; /* one for each clock, which are saved with the state */
    bool *active; /* whether each clock ticks in this event, or is to tick in the next one */
} Solver;

size_t solver_size_of_ticks(const Solver *me);

/* Allocates the arrays. Returns whether there was enough memory. */
bool solver_open(Solver *me);
void solver_close(Solver *me);

/* Goes from IN_EVENTS to IN_CONTINUOUS_TIME, unless the FMU asks to stop. */
Status solver_settle(Solver *me);
/* Goes from IN_CONTINUOUS_TIME to IN_EVENTS. */
Status solver_enter_events(Solver *me);
/* Integrates to this time, and handles all events until then and at it. */
Status solver_advance(Solver *me, double until);

/* In crossings.c: finds the first crossing in the step that ends at *end. Moves the end and next to just after
 * it. */
Status solver_locate(Solver *me, double *end);
/* In crossings.c: fails if an indicator is NaN, which has no sign. */
Status solver_check_indicators(const Solver *me, const double *z);
/* Whether an indicator becomes positive or ceases to be: FMI's events. */
static inline bool solver_crosses(const Solver *me, const double *before, const double *after) {
    bool any = false;

    for (size_t i = 0; i < me->solving->indicators; i++) {
        any |= (before[i] > 0.0) != (after[i] > 0.0);
    }
    return any;
}

/* In solver.c. Both log a message like one of the FMU. This one returns an Error. */
Status solver_fail(const Solver *me, const char *format, ...);
void solver_warn(const Solver *me, const char *format, ...);
/* Whether the step is to end early. */
bool solver_is_interrupted(Solver *me);

static inline void solver_restore_floats(const Solver *me) {
    floats_restore_if_seen(me->floats);
}

/* Whether the work goes on. */
static inline bool good(Status status) {
    return status <= STATUS_WARNING;
}

/* Like Python's max and min. Those of C are slow calls, because they care about NaN. */
static inline double larger(double a, double b) {
    return b > a ? b : a;
}
static inline double smaller(double a, double b) {
    return b < a ? b : a;
}

/* Fills jacobian, row by row, and slope: the derivatives of the rates by state and time. In
 * differentials.c. */
Status solver_differentiate(Solver *me, double step);
/* The root mean square of errors, each divided by the tolerance of its state. */
double solver_norm(const Solver *me, const double *errors);

#endif
