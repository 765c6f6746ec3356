/* Resets of an instance: initialization, warm-up, and return to a saved start. */

#include "pool/initial_states.h"

#include <stdlib.h>
#include <string.h>

#include "pool/instances.h"
#include "pool/recorded_inputs.h"

/* Initialization */

typedef struct {
    Pool *pool;
    Instance *me;
    const Access *start;
    Scratch scratch;  /* holds the start values */
    uint32_t refused; /* value reference of the String that could not be set */
} StartContext;

static Status set_start_values(void *context) {
    StartContext *c = context;
    const Floats *floats = &c->pool->floats;
    const Status status = access_set(c->start, c->me->library, c->me->component, c->scratch.values,
                                     c->scratch.typed, floats);

    if (status > STATUS_WARNING) {
        return status;
    }
    const Status of_texts = access_set_texts(c->start, c->me->library, c->me->component,
                                             c->scratch.values, floats, &c->refused);
    return of_texts > status ? of_texts : status;
}

static Status fail_initialization(Pool *pool, Instance *me, const StartContext *context,
                                  const char *doing, Status status) {
    instance_fail(pool, me, doing, status);
    if (me->failure != NULL) {
        me->failure->reference = context->refused;
    }
    if (me->phase == PHASE_INSTANTIATED) {
        me->phase = PHASE_FAILED; /* initialization stopped halfway, so a reset is necessary */
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

static Atomic initializations; /* of all pools */

uint64_t number_of_initializations(void) {
    return atomic_get(&initializations);
}

static Status initialize_once(Pool *pool, Instance *me, const Access *start, Scratch scratch) {
    const Settings *s = &pool->settings;
    StartContext context = {pool, me, start, scratch, UINT32_MAX};
    Experiment experiment = s->experiment;
    const char *doing = "initialization";
    Status status = instance_return_to_start(pool, me);

    if (status > STATUS_WARNING) {
        return status;
    }
    instance_begin_turn(pool);
    atomic_add(&initializations, 1);
    experiment.start_time = me->start_time;
    status = s->fmi->initialize(me->library, me->component, &experiment,
                                (StartValues){.set = set_start_values, .context = &context}, &doing);
    instance_end_turn(pool);
    floats_restore_if_seen(&pool->floats);
    if (status > STATUS_WARNING) {
        return fail_initialization(pool, me, &context, doing, status);
    }
    me->phase = PHASE_STEPPING;
    return warm_up(pool, me);
}

/* An initialization that fails without a word is repeated, and the FMU is asked to log all. */
static Status initialize(Pool *pool, Instance *me, const Access *start, Scratch scratch) {
    const Status status = initialize_once(pool, me, start, scratch);

    if (status > STATUS_WARNING && instance_rebuild_to_hear(pool, me)) {
        return initialize_once(pool, me, start, scratch);
    }
    return status;
}

/* Initial states. The pool saves one when the same start values occur a second time, after an
 * episode with steps. From then on it restores the saved state. */

static bool states_are_of_use(Pool *pool, const Instance *me) {
    return pool->settings.restores && !me->unsavable && !atomic_get(&pool->states_too_large);
}

static bool too_large(Pool *pool, Instance *me) {
    const Settings *s = &pool->settings;
    const size_t size = s->fmi->state_size(me->library, me->component, me->saved);
    floats_restore_if_seen(&pool->floats);
    return size > STATES_LIMIT / s->count;
}

static void keep_state(Pool *pool, Instance *me) {
    if (instance_save(pool, me, &me->saved) > STATUS_WARNING) {
        me->unsavable = true;
    } else if (too_large(pool, me)) {
        atomic_set(&pool->states_too_large, 1);
    }
}

/* The list of start variables of the last initialization, or 0. */
static uint64_t *start_id_of(const Pool *pool, const Instance *me) {
    return &pool->start_ids[index_of(pool, me)];
}

static double *start_values_of(const Pool *pool, const Instance *me) {
    return pool->starts + index_of(pool, me) * pool->start_width;
}

/* The outputs just after the initialization whose state was saved. */
static double *first_outputs_of(const Pool *pool, const Instance *me) {
    return pool->first_outputs + index_of(pool, me) * pool->settings.outputs->count;
}

static bool starts_as_before(const Pool *pool, const Instance *me, const Access *start,
                             const double *values) {
    const size_t size = start->count * sizeof *values;
    return *start_id_of(pool, me) == start->id && memcmp(start_values_of(pool, me), values, size) == 0;
}

static Status start_anew(Pool *pool, Instance *me, const Call *call, bool again, Scratch scratch) {
    const Access *start = call->start;

    instance_free_state(pool, me, &me->saved);
    const Status status = initialize(pool, me, start, scratch);
    if (status > STATUS_WARNING) {
        return status;
    }
    again = again && *start_id_of(pool, me) == start->id; /* the instance may have been replaced */
    *start_id_of(pool, me) = start->id;
    memcpy(start_values_of(pool, me), scratch.values, start->count * sizeof(double));
    if (again && states_are_of_use(pool, me)) {
        keep_state(pool, me);
    }
    return me->phase == PHASE_STEPPING ? STATUS_OK : initialize(pool, me, start, scratch);
}

static Status read_first_outputs(Pool *pool, Instance *me, Scratch scratch) {
    instance_count_from(me, pool->settings.warm_up_steps * pool->settings.substeps);
    return instance_read_outputs(pool, me, scratch);
}

static Status restart(Pool *pool, Instance *me, const Call *call, bool again, Scratch scratch) {
    const Status status = start_anew(pool, me, call, again, scratch);

    if (status > STATUS_WARNING) {
        return me->phase == PHASE_DEAD ? STATUS_FATAL : STATUS_ERROR;
    }
    const Status got = read_first_outputs(pool, me, scratch);
    if (got == STATUS_OK && me->saved != NULL) {
        instance_copy_outputs(pool, me, first_outputs_of(pool, me));
    }
    return got;
}

/* A restore may behave differently if parameters change that the trial did not know about. */
static bool starts_like_the_saved_one(Pool *pool, Instance *me, Scratch scratch) {
    const size_t size = pool->settings.outputs->count * sizeof(double);

    instance_copy_outputs(pool, me, scratch.values);
    return memcmp(scratch.values, first_outputs_of(pool, me), size) == 0;
}

static void give_state_up(Pool *pool, Instance *me) {
    instance_free_state(pool, me, &me->saved);
    me->unsavable = true;
}

static Status return_to_start(Pool *pool, Instance *me, Scratch scratch) {
    const Status status = instance_restore(pool, me, me->saved);

    if (status > STATUS_WARNING) {
        give_state_up(pool, me);
        return status;
    }
    const Status got = read_first_outputs(pool, me, scratch);
    if (got == STATUS_OK && !starts_like_the_saved_one(pool, me, scratch)) {
        give_state_up(pool, me);
    }
    return got;
}

/* A failure must not be explained by the messages of earlier episodes. */
static void forget_old_messages(Pool *pool, Instance *me) {
    const size_t index = index_of(pool, me);

    if (me->phase != PHASE_INSTANTIATED && !log_is_silent(&pool->log, index)) {
        log_forget(&pool->log, index);
        instance_hush(pool, me);
    }
}

static Status reset_instance(Pool *pool, Instance *me, const Call *call, Scratch scratch) {
    const Access *start = call->start;
    const Matrix *values = &call->start_values;
    const bool stepped = me->steps > pool->settings.warm_up_steps * pool->settings.substeps;

    health_count_steps(pool, me);
    health_of(pool, me)[RESETS]++;
    health_of(pool, me)[RETRIED] = 0;
    forget_old_messages(pool, me);
    if (instance_renew(pool, me) > STATUS_WARNING) {
        return STATUS_FATAL;
    }
    matrix_gather(values, index_of(pool, me), start->count, scratch.values);
    instance_set_start_time(pool, me, start, scratch.values);
    const bool again = starts_as_before(pool, me, start, scratch.values);

    if (!again || me->saved == NULL || me->phase == PHASE_DEAD || !states_are_of_use(pool, me)) {
        return restart(pool, me, call, again && stepped, scratch);
    }
    const Status status = return_to_start(pool, me, scratch);
    if (me->saved != NULL) {
        return status;
    }
    /* the restore did not work, and it has overwritten the start values */
    matrix_gather(values, index_of(pool, me), start->count, scratch.values);
    return restart(pool, me, call, again, scratch);
}

Status instance_reset(Pool *pool, Instance *me, const Call *call, Scratch scratch) {
    const Status status = reset_instance(pool, me, call, scratch);

    if (pool->records != NULL) {
        matrix_gather(&call->start_values, index_of(pool, me), call->start->count, scratch.values);
        record_begin(pool, index_of(pool, me), call->start, scratch.values);
    }
    return status;
}
