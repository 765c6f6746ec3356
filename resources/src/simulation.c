/* The state machine, initialization and the communication step. */

#include "simulation.h"

#include <float.h>
#include <math.h>

#include "log.h"
#include "solvers.h"

/* A communication step that needs more internal steps than this is taken for a mistake. */
static const double MAX_INTERNAL_STEPS = 1e8;

static const char *name_of(int32_t phase) {
    switch (phase) {
    case PHASE_INSTANTIATED:
        return "after instantiation";
    case PHASE_EXPERIMENT_SET_UP:
        return "after the experiment's set-up";
    case PHASE_INITIALIZATION:
        return "in Initialization Mode";
    case PHASE_STEP:
        return "after initialization";
    default:
        return "after termination";
    }
}

Status check_phase(const Instance *instance, const char *function, int32_t allowed) {
    if (instance == NULL) {
        return STATUS_ERROR;
    }
    if (instance->simulation.phase & allowed) {
        return STATUS_OK;
    }
    return report(instance, STATUS_ERROR, function, "must not be called %s",
                  name_of(instance->simulation.phase));
}

Status set_up_experiment(Instance *instance, const char *function, double start_time,
                         bool stop_time_defined, double stop_time) {
    const Status status =
        check_phase(instance, function, PHASE_INSTANTIATED | PHASE_EXPERIMENT_SET_UP);
    if (status != STATUS_OK) {
        return status;
    }
    if (!isfinite(start_time) || (stop_time_defined && !(stop_time >= start_time))) {
        return report(instance, STATUS_ERROR, function,
                      "the start time %g and the stop time %g must be a time span", start_time, stop_time);
    }
    instance->simulation.reals.time = start_time;
    instance->simulation.stop_time = stop_time_defined ? stop_time : INFINITY;
    instance->simulation.phase = PHASE_EXPERIMENT_SET_UP;
    return STATUS_OK;
}

Status enter_initialization(Instance *instance, const char *function) {
    const Status status = check_phase(instance, function, PHASE_EXPERIMENT_SET_UP);
    if (status == STATUS_OK) {
        instance->simulation.phase = PHASE_INITIALIZATION;
        instance->simulation.stale = true;
    }
    return status;
}

static bool all_finite(const double *values, int number) {
    int64_t bad = 0; /* as wide as the values, which lets the compiler vectorize */

    for (int i = 0; i < number; i++) {
        bad |= !(fabs(values[i]) <= DBL_MAX);
    }
    return bad == 0;
}

/* Solves the initial equations. */
static Status initialize(Instance *instance, const char *function) {
    Simulation *s = &instance->simulation;
    const char *problem = model_constants(&s->reals, s->enumerations, &s->constants);

    if (problem == NULL && !(s->reals.max_step > 0.0)) {
        problem = "max_step must be positive";
    }
    if (problem == NULL &&
        !all_finite((const double *)&s->constants, sizeof(Constants) / sizeof(double))) {
        problem = "the parameters must be finite and of sensible size";
    }
    if (problem == NULL) {
        model_initial_state(&s->reals);
        model_outputs(&s->reals, &s->constants);
        if (!all_finite(&s->reals.values[FIRST_STATE], NUMBER_OF_STATES)) {
            problem = "the initial state must be finite";
        }
    }
    return problem == NULL ? STATUS_OK
                           : report(instance, STATUS_ERROR, function, "%s", problem);
}

Status exit_initialization(Instance *instance, const char *function) {
    Status status = check_phase(instance, function, PHASE_INITIALIZATION);
    if (status == STATUS_OK) {
        status = initialize(instance, function);
    }
    if (status == STATUS_OK) {
        instance->simulation.phase = PHASE_STEP;
        instance->simulation.stale = true;
    }
    return status;
}

Status refresh(Instance *instance, const char *function) {
    Simulation *s = &instance->simulation;
    double derivative[NUMBER_OF_STATES];

    if (!s->stale) {
        return STATUS_OK;
    }
    if (s->phase == PHASE_INITIALIZATION && initialize(instance, function) != STATUS_OK) {
        return STATUS_ERROR;
    }
    model_derivatives(&s->reals, &s->constants, &s->reals.values[FIRST_STATE], derivative);
    for (int i = 0; i < NUMBER_OF_DERIVATIVES; i++) {
        s->reals.values[FIRST_DERIVATIVE + i] = derivative[MODEL_ORDER * (i + 1) - 1];
    }
    if (HAS_FEEDTHROUGH) {
        model_outputs(&s->reals, &s->constants);
    }
    s->stale = false;
    return STATUS_OK;
}

static Status check_step(const Instance *instance, const char *function, double time,
                         double step) {
    const Simulation *s = &instance->simulation;
    /* Rounding differs: some importers compute start + n * step, others add up steps. */
    const double tolerance = 1e-9 * (1.0 + fabs(s->reals.time));

    if (!(step >= 0.0 && step <= DBL_MAX)) {
        return report(instance, STATUS_ERROR, function,
                      "the communication step size must be finite and not negative, not %g", step);
    }
    if (!(fabs(time - s->reals.time) <= tolerance)) {
        return report(instance, STATUS_ERROR, function,
                      "the communication point is %.17g, but the last step ended at %.17g", time,
                      s->reals.time);
    }
    if (time + step > s->stop_time + tolerance) {
        return report(instance, STATUS_ERROR, function,
                      "the step to %.17g goes beyond the stop time %.17g", time + step,
                      s->stop_time);
    }
    if (step > MAX_INTERNAL_STEPS * s->reals.max_step) {
        return report(instance, STATUS_ERROR, function,
                      "a step of %g needs more than %g internal steps of max_step = %g", step,
                      MAX_INTERNAL_STEPS, s->reals.max_step);
    }
    return STATUS_OK;
}

/* Rounding alone must not add an internal step where the step is a multiple of max_step. */
static int32_t number_of_internal_steps(double step, double max_step) {
    return step <= max_step ? 1 : (int32_t)fmax(1.0, ceil(step / max_step - 1e-9));
}

static Status advance(Instance *instance, const char *function, double time, double step) {
    Simulation *s = &instance->simulation;
    const int32_t number = number_of_internal_steps(step, s->reals.max_step);
    double state[NUMBER_OF_STATES];

    for (int i = 0; i < NUMBER_OF_STATES; i++) {
        state[i] = s->reals.values[FIRST_STATE + i];
    }
    integrate(&s->reals, &s->constants, s->enumerations[ENUM_solver], step / number, number, state);
    if (!all_finite(state, NUMBER_OF_STATES)) {
        return report(instance, STATUS_DISCARD, function,
                      "the step from %g to %g leads to a state that is not finite", time,
                      time + step);
    }
    for (int i = 0; i < NUMBER_OF_STATES; i++) {
        s->reals.values[FIRST_STATE + i] = state[i];
    }
    s->reals.time = time + step;
    if (!HAS_FEEDTHROUGH) {
        model_outputs(&s->reals, &s->constants);
    }
    s->stale = true;
    return STATUS_OK;
}

Status do_step(Instance *instance, const char *function, double time, double step) {
    Status status = check_phase(instance, function, PHASE_STEP);
    if (status == STATUS_OK) {
        status = check_step(instance, function, time, step);
    }
    if (status == STATUS_OK) {
        status = advance(instance, function, time, step);
        instance->simulation.step_status = status;
    }
    return status;
}

Status terminate(Instance *instance, const char *function) {
    const Status status = check_phase(instance, function, PHASE_STEP);
    if (status == STATUS_OK) {
        instance->simulation.phase = PHASE_TERMINATED;
    }
    return status;
}
