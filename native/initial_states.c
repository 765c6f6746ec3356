#include "initial_states.h"

#include <stdlib.h>
#include <string.h>

#include "instances.h"

static const size_t STATES_LIMIT = (size_t)256 << 20; /* bytes of initial states of one pool */

enum {
    TRIALS = 5,
    REHEARSED = 3 /* steps */
};

/* Initialization */

typedef struct {
    Pool *pool;
    Instance *me;
    const Access *start;
    Scratch scratch;  /* holds the start values */
    uint32_t refused; /* the String that could not be set */
} StartContext;

static Status set_start_values(void *context) {
    StartContext *c = context;
    const Settings *s = &c->pool->settings;
    Status status = access_set(c->start, c->me->library, c->me->component, c->scratch.values,
                               c->scratch.typed, &c->pool->floats);

    for (size_t i = 0; i < s->number_of_strings && status <= STATUS_WARNING; i++) {
        const StringValue *string = &s->strings[i];
        status =
            s->fmi->set_string(c->me->library, c->me->component, string->reference, string->text);
        floats_restore_if_seen(&c->pool->floats);
        c->refused = status > STATUS_WARNING ? string->reference : c->refused;
    }
    return status;
}

static Status fail_initialization(Pool *pool, Instance *me, const StartContext *context,
                                  const char *doing, Status status) {
    instance_fail(pool, me, doing, status);
    if (me->failure != NULL) {
        me->failure->string_reference = context->refused;
    }
    if (me->phase == PHASE_INSTANTIATED) {
        me->phase = PHASE_FAILED; /* somewhere in the middle of it: a reset is due */
    }
    return status;
}

static Status warm_up(Pool *pool, Instance *me) {
    instance_count_from(me, 0);
    for (int64_t i = 0; i < pool->settings.warm_up_steps; i++) {
        const Status status = instance_advance(pool, me);
        instance_count_from(me, me->steps);
        if (status > STATUS_WARNING) {
            if (me->failure != NULL) {
                me->failure->in_warm_up = true;
            }
            return status;
        }
    }
    return STATUS_OK;
}

static Status initialize(Pool *pool, Instance *me, const Access *start, Scratch scratch) {
    const Settings *s = &pool->settings;
    StartContext context = {pool, me, start, scratch, UINT32_MAX};
    const char *doing = "initialization";
    Status status = instance_return_to_start(pool, me);

    if (status > STATUS_WARNING) {
        return status;
    }
    status = s->fmi->initialize(me->library, me->component, &s->experiment,
                                (StartValues){set_start_values, &context}, &doing);
    floats_restore_if_seen(&pool->floats);
    if (status > STATUS_WARNING) {
        return fail_initialization(pool, me, &context, doing, status);
    }
    me->phase = PHASE_STEPPING;
    return warm_up(pool, me);
}

/* Initial states: kept once the same start values come a second time, after an episode with steps,
 * and restored from then on. */

static bool states_are_of_use(Pool *pool, const Instance *me) {
    return pool->settings.can_save && !me->unsavable && !atomic_get(&pool->trial.refuted);
}

static void give_states_up(Pool *pool) {
    atomic_set(&pool->trial.refuted, 1);
}

static bool owns_trial(Pool *pool, const Instance *me) {
    const uint64_t mine = index_of(pool, me) + 1;
    uint64_t owner = atomic_get(&pool->trial.owner);
    return owner == mine || (owner == 0 && atomic_replace(&pool->trial.owner, &owner, mine));
}

static bool too_large(Pool *pool, Instance *me) {
    const Settings *s = &pool->settings;
    const size_t size = s->fmi->state_size(me->library, me->component, me->saved);
    floats_restore_if_seen(&pool->floats);
    return size > STATES_LIMIT / s->count;
}

/* Steps with inputs; returns whether that went well. */
static bool try_steps(Pool *pool, Instance *me, const double *inputs, double *outputs,
                      void *typed) {
    const Access *access = pool->settings.outputs;
    const int64_t before = me->steps;

    atomic_set(&pool->log.muted, index_of(pool, me) + 1); /* nobody has asked for these steps */
    bool well = access_set(pool->settings.inputs, me->library, me->component, inputs, typed,
                           &pool->floats) <= STATUS_WARNING;

    for (size_t i = 0; i < REHEARSED && well; i++, outputs += access->count) {
        well = instance_advance(pool, me) <= STATUS_WARNING &&
               access_get(access, me->library, me->component, outputs, typed, &pool->floats) <=
                   STATUS_WARNING;
    }
    atomic_set(&pool->log.muted, 0);
    me->steps = before;
    return well;
}

/* Steps twice from the kept state, with the inputs that were written last: an FMU may have left a
 * part of its state out. */
static bool rehearse(Pool *pool, Instance *me, const Matrix *inputs, void *typed) {
    const size_t width = pool->settings.inputs->count;
    const size_t size = REHEARSED * pool->settings.outputs->count;
    double *memory = malloc((width + 2 * size + 1) * sizeof *memory);
    bool well = memory != NULL;

    if (well) {
        matrix_gather(inputs, index_of(pool, me), width, memory);
        well = all_finite(memory, width);
    }
    for (size_t i = 0; i < 2 && well; i++) {
        well = try_steps(pool, me, memory, memory + width + i * size, typed) &&
               instance_restore(pool, me, me->saved) <= STATUS_WARNING;
    }
    well = well && memcmp(memory + width, memory + width + size, size * sizeof *memory) == 0;
    free(memory);
    return well;
}

static Status keep_state(Pool *pool, Instance *me, uint64_t initialization, const Matrix *inputs,
                         void *typed) {
    const Status status = instance_save(pool, me, &me->saved);

    if (status > STATUS_WARNING) {
        me->unsavable = true;
        return status;
    }
    if (!owns_trial(pool, me)) {
        return STATUS_OK;
    }
    pool->trial.initialization = initialization;
    if (too_large(pool, me)) {
        give_states_up(pool);
    } else if (!pool->trial.rehearsed && !rehearse(pool, me, inputs, typed)) {
        give_states_up(pool);
        failure_drop(me);
        instance_free_state(pool, me, &me->saved);
        return instance_judge(me, STATUS_ERROR); /* to be initialized anew */
    }
    pool->trial.rehearsed = true;
    return STATUS_OK;
}

static double *start_values_of(const Pool *pool, const Instance *me) {
    return pool->starts + index_of(pool, me) * pool->start_width;
}

static bool starts_as_before(const Pool *pool, const Instance *me, const Access *start,
                             const double *values) {
    const size_t size = start->count * sizeof *values;
    return me->start_id == start->id && memcmp(start_values_of(pool, me), values, size) == 0;
}

static Status start_anew(Pool *pool, Instance *me, const Call *call, bool again, Scratch scratch) {
    const Access *start = call->start;
    const uint64_t began = again ? clock_now() : 0;

    instance_free_state(pool, me, &me->saved);
    const Status status = initialize(pool, me, start, scratch);
    if (status > STATUS_WARNING) {
        return status;
    }
    again = again && me->start_id == start->id; /* it may have been replaced */
    me->start_id = start->id;
    memcpy(start_values_of(pool, me), scratch.values, start->count * sizeof(double));
    if (!again || !states_are_of_use(pool, me)) {
        return STATUS_OK;
    }
    if (keep_state(pool, me, clock_now() - began, &call->inputs, scratch.typed) <= STATUS_WARNING) {
        return STATUS_OK;
    }
    return me->phase == PHASE_STEPPING ? STATUS_OK : initialize(pool, me, start, scratch);
}

/* Compares a restored instance with the initialized one; returns whether it may go on so. */
static bool passes_trial(Pool *pool, Instance *me, uint64_t restoration, Scratch scratch) {
    Trial *trial = &pool->trial;
    const size_t size = pool->settings.outputs->count * sizeof(double);

    instance_copy_outputs(pool, me, scratch.values);
    if (memcmp(scratch.values, trial->outputs, size) != 0) {
        give_states_up(pool);
        return false;
    }
    if (trial->trials == 0 || restoration < trial->restoration) {
        trial->restoration = restoration;
    }
    if (++trial->trials == TRIALS && trial->restoration > trial->initialization) {
        give_states_up(pool);
    }
    return true;
}

static Status restart(Pool *pool, Instance *me, const Call *call, bool again, Scratch scratch) {
    Status status = start_anew(pool, me, call, again, scratch);

    if (status > STATUS_WARNING) {
        return me->phase == PHASE_DEAD ? STATUS_FATAL : STATUS_ERROR;
    }
    instance_count_from(me, pool->settings.warm_up_steps * pool->settings.substeps);
    status = instance_read_outputs(pool, me, scratch);
    if (status == STATUS_OK && me->saved != NULL && owns_trial(pool, me)) {
        instance_copy_outputs(pool, me, pool->trial.outputs);
    }
    return status;
}

static Status return_to_start(Pool *pool, Instance *me, Scratch scratch) {
    const Status status = instance_restore(pool, me, me->saved);

    if (status > STATUS_WARNING) {
        instance_free_state(pool, me, &me->saved);
        me->unsavable = true;
        return status;
    }
    instance_count_from(me, pool->settings.warm_up_steps * pool->settings.substeps);
    return instance_read_outputs(pool, me, scratch);
}

/* By the cheapest way that gives the same as a fresh instance. */
Status instance_reset(Pool *pool, Instance *me, const Call *call, Scratch scratch) {
    const Access *start = call->start;
    const Matrix *values = &call->start_values;
    const bool stepped = me->steps > pool->settings.warm_up_steps * pool->settings.substeps;

    health_count_steps(pool, me);
    health_of(pool, me)[RESETS]++;
    health_of(pool, me)[RETRIED] = 0;
    if (me->due && instance_recycle(pool, me) > STATUS_WARNING) {
        return STATUS_FATAL;
    }
    matrix_gather(values, index_of(pool, me), start->count, scratch.values);
    const bool again = starts_as_before(pool, me, start, scratch.values);

    if (!again || me->saved == NULL || me->phase == PHASE_DEAD || !states_are_of_use(pool, me)) {
        return restart(pool, me, call, again && stepped, scratch);
    }
    const bool trying = owns_trial(pool, me) && pool->trial.trials < TRIALS;
    const uint64_t began = trying ? clock_now() : 0;
    const Status status = return_to_start(pool, me, scratch);
    const bool refused = me->saved == NULL;
    if (!refused && (!trying || status > STATUS_WARNING ||
                     passes_trial(pool, me, clock_now() - began, scratch))) {
        return status;
    }
    matrix_gather(values, index_of(pool, me), start->count, scratch.values);
    return restart(pool, me, call, again, scratch);
}
