#include "ramp.h"

#include <math.h>

#include "shared.h"
#include "solver.h"
#include "update.h"

enum { MOST_AT_ONCE = 64 };

/* The functions for values of FMI 1.0 and 2.0. */
static const Older *older(const Solver *me) {
    return me->library->functions;
}

Status ramps_begin(Solver *me) {
    const Solving *s = me->solving;
    Status status = STATUS_OK;

    for (size_t i = 0; i < s->number_of_ramps && status <= STATUS_WARNING; i++) {
        double value = 0.0;
        status = me->model->fmi->get(me->library, me->component, TYPE_FLOAT64,
                                     &s->ramped_references[i], 1, &value, 1);
        solver_restore_floats(me);
        me->ramps[i] = (Ramp){value, value, me->memory.time};
    }
    return status;
}

void ramps_aim(Solver *me, const uint32_t *references, size_t count, const double *values) {
    const Solving *s = me->solving;

    for (size_t i = 0; i < s->number_of_ramps; i++) {
        for (size_t j = 0; j < count; j++) {
            if (references[j] == s->ramped_references[i]) {
                me->ramps[i] = (Ramp){me->ramps[i].to, values[j], NAN};
            }
        }
    }
}

/* Sets the inputs of some ramps with one call for the values and one for the derivatives, which FMI 3.0 does
 * not have. */
static Status set_some(Solver *me, size_t first, size_t count, const double *values,
                       const double *slopes) {
    const uint32_t *references = me->solving->ramped_references + first;
    Status status = me->model->fmi->set(me->library, me->component, TYPE_FLOAT64, references,
                                        count, values, count);
    int orders[MOST_AT_ONCE]; /* all first derivatives */

    for (size_t i = 0; i < count; i++) {
        orders[i] = 1;
    }
    solver_restore_floats(me);
    if (me->updates != NULL) {
        return status;
    }
    if (older(me)->set_derivatives == NULL) {
        return solver_fail(me, "the FMU lacks its function for the derivatives of inputs");
    }
    if (status <= STATUS_WARNING) {
        status = sane(
            older(me)->set_derivatives(me->component, references, count, orders, slopes));
        solver_restore_floats(me);
    }
    return status;
}

Status ramps_set(Solver *me, double time) {
    const Solving *s = me->solving;
    double values[MOST_AT_ONCE], slopes[MOST_AT_ONCE];
    Status status = STATUS_OK;
    size_t count = 0;

    for (size_t i = 0; i < s->number_of_ramps && status <= STATUS_WARNING; i++) {
        Ramp *ramp = &me->ramps[i];
        ramp->start = isnan(ramp->start) ? time : ramp->start;
        const double slope = (ramp->to - ramp->from) / s->ramp_duration;
        const double passed = time - ramp->start;
        const bool over = passed > (1.0 - 1e-9) * s->ramp_duration;
        values[count] = over ? ramp->to : ramp->from + slope * passed;
        slopes[count++] = over ? 0.0 : slope;
        if (count == MOST_AT_ONCE || i + 1 == s->number_of_ramps) {
            status = set_some(me, i + 1 - count, count, values, slopes);
            count = 0;
        }
    }
    return status;
}

bool ramps_move(const Solver *me) {
    bool any = false;

    for (size_t i = 0; i < me->solving->number_of_ramps; i++) {
        any |= me->ramps[i].from != me->ramps[i].to;
    }
    return any;
}

Status ramps_step(Solver *me, double time, double size) {
    double reached = time;
    bool event = false, terminate = false;

    me->memory.time = time;
    const Status status = ramps_set(me, time);
    return status > STATUS_WARNING ? status
                                   : updates_step(me, time, size, &reached, &event, &terminate);
}

bool ramps_own(const Solver *me, uint32_t reference) {
    const Solving *s = me->solving;
    bool own = false;

    for (size_t i = 0; i < s->number_of_ramps; i++) {
        own |= s->ramped_references[i] == reference;
    }
    return own;
}
