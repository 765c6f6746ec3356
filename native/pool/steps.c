/* Steps of one instance, and the reading of its outputs. */

#include "pool/steps.h"

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "pool/instances.h"
#include "program/lanes.h"

static const char *const BAD_INPUTS = "the inputs are not finite";
const char *const BAD_OUTPUTS = "the outputs are not finite";

/* FMI forbids further steps after a step that failed. */
static void forbid_steps(Instance *me) {
    if (me->phase == PHASE_STEPPING) {
        me->phase = PHASE_ENDED;
    }
}

Status instance_fail_step(Pool *pool, Instance *me, double time, Status status) {
    instance_fail(pool, me, "the step", status);
    forbid_steps(me);
    if (me->failure != NULL) {
        me->failure->time = time;
    }
    return status;
}

/* Does a communication step as several smaller ones. */
static Status step_in_parts(Pool *pool, Instance *me, double time, int64_t parts) {
    const Settings *s = &pool->settings;
    const double size = pool->step_size / (double)parts;
    Status status = STATUS_OK;

    for (int64_t i = 0; i < parts && status <= STATUS_WARNING; i++) {
        status = s->fmi->do_step(me->library, me->component, time + (double)i * size, size,
                                 pool->no_return);
        floats_restore_if_seen(&pool->floats);
    }
    return status;
}

/* FMI forbids stepping on after a discarded step. So each try begins at the state before the
 * first one. */
static Status retry(Pool *pool, Instance *me, double time, void *before) {
    const Settings *s = &pool->settings;
    int64_t *health = health_of(pool, me);
    Status status = STATUS_DISCARD;

    for (int64_t i = 1; i <= s->retries && status == STATUS_DISCARD; i++) {
        const Status restored = s->fmi->set_state(me->library, me->component, before);
        floats_restore_if_seen(&pool->floats);
        if (restored > STATUS_WARNING) {
            return restored;
        }
        health[RETRIES]++;
        health[RETRIED]++;
        status = step_in_parts(pool, me, time, (int64_t)1 << i);
    }
    return status;
}

static Status step_with_retries(Pool *pool, Instance *me, double time) {
    void *before = NULL;
    Status status = pool->settings.fmi->get_state(me->library, me->component, &before);

    floats_restore_if_seen(&pool->floats);
    if (status > STATUS_WARNING) {
        return status;
    }
    status = step_in_parts(pool, me, time, 1);
    if (status == STATUS_DISCARD) {
        status = retry(pool, me, time, before);
    }
    instance_judge(me, status);
    const Status freed = instance_free_state(pool, me, &before);
    return status > STATUS_WARNING ? status : freed;
}

static Status step_once(Pool *pool, Instance *me) {
    const double time = instance_time(pool, me);
    const Status status = pool->settings.retries == 0 ? step_in_parts(pool, me, time, 1)
                                                      : step_with_retries(pool, me, time);

    me->steps++;
    return status > STATUS_WARNING ? instance_fail_step(pool, me, time, status) : status;
}

Status instance_advance(Pool *pool, Instance *me) {
    Status status = STATUS_OK;
    for (int64_t i = 0; i < pool->settings.substeps && status <= STATUS_WARNING; i++) {
        status = step_once(pool, me);
    }
    return status;
}

/* Adds what the outputs are after a substep to what is collected of the step. */
static void collect(const Settings *s, bool first, const double *values, double *collected) {
    for (size_t i = 0; i < s->outputs->count; i++) {
        const double value = values[i], before = collected[i];
        switch (first ? SAMPLE_LAST : s->sampling[i]) {
        case SAMPLE_MEAN:
        case SAMPLE_INTEGRAL:
            collected[i] = before + value;
            break;
        case SAMPLE_MIN:
            collected[i] = before <= value ? before : value;
            break;
        case SAMPLE_MAX:
            collected[i] = before >= value ? before : value;
            break;
        default:
            collected[i] = value;
        }
    }
}

/* Turns what is collected of a step into the outputs. */
static void conclude(const Pool *pool, int64_t substeps, const double *collected, double *values) {
    const Settings *s = &pool->settings;

    for (size_t i = 0; i < s->outputs->count; i++) {
        values[i] = collected[i];
        if (s->sampling[i] == SAMPLE_MEAN) {
            values[i] /= (double)substeps;
        } else if (s->sampling[i] == SAMPLE_INTEGRAL) {
            values[i] *= pool->step_size;
        }
    }
}

/* Does the substeps of a step. Reads the outputs after each of them, and collects them in the
 * scratch memory for values. */
static Status advance_sampled(Pool *pool, Instance *me, Scratch scratch) {
    const Settings *s = &pool->settings;
    Status status = STATUS_OK;
    int64_t done = 0;

    while (done < s->substeps && status <= STATUS_WARNING) {
        status = step_once(pool, me);
        if (status > STATUS_WARNING && status != STATUS_TERMINATED) {
            return status;
        }
        const Status got = access_get(s->outputs, me->library, me->component, scratch.outputs,
                                      scratch.typed, &pool->floats);
        if (got > STATUS_WARNING) {
            return instance_fail_reading(pool, me, got);
        }
        collect(s, done++ == 0, scratch.outputs, scratch.values);
    }
    conclude(pool, done, scratch.values, scratch.outputs);
    return status;
}

WIDE bool all_within(const double *values, size_t count, double limit) {
    int64_t bad = 0; /* as wide as the values, so that the compiler can vectorize */

    UNROLLED
    for (size_t i = 0; i < count; i++) {
        bad |= !(fabs(values[i]) <= limit);
    }
    return bad == 0;
}

bool are_finite(const double *values, size_t count) {
    return all_within(values, count, DBL_MAX);
}

void instance_copy_outputs(const Pool *pool, const Instance *me, double *values) {
    const Settings *s = &pool->settings;
    const double *place = s->output_values + index_of(pool, me);

    for (size_t i = 0; i < s->outputs->count; i++, place += s->count) {
        values[i] = *place;
    }
}

static Status read_all(Pool *pool, Instance *me, Scratch scratch) {
    const Settings *s = &pool->settings;

    if (s->start_outputs != NULL && me->steps == 0) {
        memcpy(scratch.values, s->start_outputs, s->outputs->count * sizeof *scratch.values);
        return STATUS_OK;
    }
    return access_get(s->outputs, me->library, me->component, scratch.values, scratch.typed,
                      &pool->floats);
}

Status instance_read_outputs(Pool *pool, Instance *me, Scratch scratch) {
    const Settings *s = &pool->settings;
    const size_t count = s->outputs->count;
    const Status got = read_all(pool, me, scratch);

    if (got > STATUS_WARNING) {
        return instance_fail(pool, me, "reading the outputs", got);
    }
    if (!are_finite(scratch.values, count)) {
        return instance_note_not_finite(me, BAD_OUTPUTS, scratch.values, count);
    }
    double *place = s->output_values + index_of(pool, me);
    for (size_t i = 0; i < count; i++, place += s->count) {
        const bool is_integral = s->sampling != NULL && s->sampling[i] == SAMPLE_INTEGRAL;
        *place = is_integral ? 0.0 : scratch.values[i];
    }
    return STATUS_OK;
}

void matrix_gather(const Matrix *matrix, size_t column, size_t rows, double *values) {
    const char *place = matrix->data + (ptrdiff_t)column * matrix->column_stride;
    for (size_t i = 0; i < rows; i++, place += matrix->row_stride) {
        memcpy(&values[i], place, sizeof values[i]);
    }
}

Status instance_fail_reading(Pool *pool, Instance *me, Status status) {
    instance_fail(pool, me, "reading the outputs", status);
    forbid_steps(me); /* FMI may forbid further steps now */
    return status;
}

Status instance_fail_setting(Pool *pool, Instance *me, Status status) {
    return instance_fail(pool, me, "setting the inputs", status);
}

Status instance_step(Pool *pool, Instance *me, Scratch scratch) {
    const Settings *s = &pool->settings;

    if (me->phase != PHASE_STEPPING) {
        return instance_refuse(me, "the instance needs a reset before it can be stepped");
    }
    if (!scratch.sound && !are_finite(scratch.inputs, s->inputs->count)) {
        return instance_note_not_finite(me, BAD_INPUTS, scratch.inputs, s->inputs->count);
    }
    if (s->retries > 0) {
        health_of(pool, me)[RETRIED] = 0;
    }
    const Status set = access_set(s->inputs, me->library, me->component, scratch.inputs,
                                  scratch.typed, &pool->floats);
    if (set > STATUS_WARNING) {
        return instance_fail_setting(pool, me, set);
    }
    if (s->sampling != NULL) {
        return advance_sampled(pool, me, scratch);
    }
    const Status status = instance_advance(pool, me);
    if (status > STATUS_WARNING && status != STATUS_TERMINATED) {
        return status;
    }
    const Status got = access_get(s->outputs, me->library, me->component, scratch.outputs,
                                  scratch.typed, &pool->floats);
    return got > STATUS_WARNING ? instance_fail_reading(pool, me, got) : status;
}
