#include "lone.h"

#include <float.h>
#include <math.h>
#include <string.h>

#include "records.h"
#include "runs.h"

enum { MOST = 64 }; /* inputs, and outputs */

bool lone_fits(const Task *task) {
    const Settings *s = &task->pool->settings;

    return s->count == 1 && task->operation == STEP && task->call->mask.data == NULL &&
           s->inputs->width <= MOST && s->outputs->width <= MOST;
}

/* One call of the FMI version sets the inputs, does the step, and reads the outputs. */
static Status step_directly(Pool *pool, Scratch scratch) {
    Instance *me = pool->instances;
    const double time = instance_time(pool, me);
    const uint32_t place = 0;
    Outcome outcome;
    Exchange e = run_exchange(pool, scratch);

    e.count = 1;
    e.components = &me->component;
    e.places = &place;
    e.times = &time;
    e.outcomes = &outcome;
    me->steps++;
    pool->settings.fmi->exchange(me->library, &e);
    return run_status(pool, me, time, outcome);
}

static inline bool are_within(const double *values, size_t count, double limit) {
    bool within = true;

    for (size_t i = 0; i < count; i++) {
        within &= fabs(values[i]) <= limit;
    }
    return within;
}

static Status step(Pool *pool, Scratch scratch) {
    Instance *me = pool->instances;
    const bool direct = pool->direct && me->phase == PHASE_STEPPING &&
                        are_within(scratch.inputs, pool->settings.inputs->count, DBL_MAX);

    return direct ? step_directly(pool, scratch) : instance_step(pool, me, scratch);
}

static void keep(const Task *task, const double *outputs) {
    const Settings *s = &task->pool->settings;
    float *observation = task->call->observations;

    s->status[0] = STATUS_OK;
    for (size_t i = 0; i < s->outputs->count; i++) {
        s->output_values[i] = outputs[i];
    }
    for (size_t i = 0; observation != NULL && i < s->num_observed; i++) {
        observation[i] = (float)outputs[i];
    }
}

size_t lone_step(Task *task) {
    Pool *pool = task->pool;
    const Settings *s = &pool->settings;
    double values[MOST], typed[MOST], inputs[MOST], outputs[MOST];
    const Scratch scratch = {values, typed, inputs, outputs, false};

    matrix_gather(&task->call->inputs, 0, s->inputs->count, inputs);
    record_add(pool, 0, inputs);
    const Status status = step(pool, scratch);
    if (status != STATUS_OK || !are_within(outputs, s->outputs->count, FLOAT32_LIMIT)) {
        return run_conclude(task, status, scratch);
    }
    keep(task, outputs);
    return 0;
}
