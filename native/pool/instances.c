/* Instances: creation, replacement, and saved states. */

#include "pool/instances.h"

#include "pool/copies.h"
#include "pool/failures.h"
#include "pool/loading.h"
#include "shared/floats.h"

static const char *name_of(const Pool *pool, size_t index) {
    return pool->names + index * LOG_NAME;
}

void instance_begin_turn(Pool *pool) {
    if (pool->settings.one_initialization) {
        mutex_lock(pool->making);
    }
}

void instance_end_turn(Pool *pool) {
    if (pool->settings.one_initialization) {
        mutex_unlock(pool->making);
    }
}

static bool build(Pool *pool, Instance *me, bool logging) {
    const Settings *s = &pool->settings;
    const size_t index = index_of(pool, me);
    const Identity identity = {name_of(pool, index), s->token, s->resources,
                               log_environment(&pool->log, index), logging,
                               &s->solving, &pool->floats};

    if (s->elsewhere) {
        return false;
    }
    mutex_lock(pool->making);
    me->component = s->fmi->instantiate(me->library, &identity);
    mutex_unlock(pool->making);
    floats_restore_if_seen(&pool->floats);
    me->phase = me->component == NULL ? PHASE_DEAD : PHASE_INSTANTIATED;
    me->hearing = logging ? HEARING_ALL : HEARING_LITTLE;
    return me->component != NULL;
}

static Status choose_messages(const Pool *pool, Instance *me, size_t count) {
    const Settings *s = &pool->settings;
    const Status status =
        s->fmi->choose_messages(me->library, me->component, s->categories, count);

    floats_restore_if_seen(&pool->floats);
    return instance_judge(me, status);
}

/* Asks the FMU to log why calls fail. If that call fails itself, a new instance takes its place. */
static bool ask_for_errors(Pool *pool, Instance *me) {
    const Settings *s = &pool->settings;

    if (s->logging || s->number_of_categories == 0 || s->fmi->choose_messages == NULL ||
        atomic_get(&pool->no_categories)) {
        return true;
    }
    if (choose_messages(pool, me, s->number_of_categories) <= STATUS_WARNING) {
        me->hearing = HEARING_ERRORS;
        return true;
    }
    atomic_set(&pool->no_categories, 1);
    instance_discard(pool, me);
    return build(pool, me, false);
}

/* An FMU that logs nothing may take long to be instantiated, and it may fail often. */
static bool may_hear_all(Pool *pool) {
    enum { MOST = 4 };
    return !pool->settings.logging && atomic_add(&pool->heard, 1) < MOST;
}

bool instance_build(Pool *pool, Instance *me) {
    if (build(pool, me, pool->settings.logging)) {
        return ask_for_errors(pool, me);
    }
    return log_is_silent(&pool->log, index_of(pool, me)) && may_hear_all(pool) &&
           build(pool, me, true);
}

/* Whether a call of the FMU failed, and the FMU did not say why. A wish to stop is no failure. */
static bool is_unexplained(const Instance *me) {
    const Failure *failure = me->failure;
    return failure != NULL && failure->status >= 0 && failure->status != STATUS_TERMINATED &&
           failure->said == NULL;
}

bool instance_rebuild_to_hear(Pool *pool, Instance *me) {
    if (!is_unexplained(me) || me->phase == PHASE_DEAD || me->hearing == HEARING_ALL ||
        pool->snapshots != NULL || !may_hear_all(pool)) {
        return false;
    }
    instance_discard(pool, me);
    if (!build(pool, me, true)) {
        return false;
    }
    failure_drop(me);
    return true;
}

void instance_hush(Pool *pool, Instance *me) {
    if (me->hearing == HEARING_ERRORS && me->phase == PHASE_STEPPING &&
        atomic_get(&pool->log.idle) > LOG_IDLE_LIMIT) {
        me->hearing = HEARING_LITTLE;
        atomic_set(&pool->no_categories, 1);
        choose_messages(pool, me, 0);
    }
}

Status instance_free_state(const Pool *pool, Instance *me, void **state) {
    Status status = STATUS_OK;

    if (*state != NULL && me->phase != PHASE_DEAD) {
        status =
            instance_judge(me, pool->settings.fmi->free_state(me->library, me->component, state));
        floats_restore_if_seen(&pool->floats);
    }
    *state = NULL; /* FMI forbids freeing the state after Fatal, so its memory is lost */
    return status;
}

/* Several threads may replace instances at the same time. Each of them touches only the states
 * of its own instance. Snapshots are linked and unlinked under the pool's lock. */
static void free_states(Pool *pool, Instance *me) {
    const size_t index = index_of(pool, me);

    instance_free_state(pool, me, &me->saved);
    for (Snapshot *snapshot = pool->snapshots; snapshot != NULL; snapshot = snapshot->next) {
        if (snapshot->kept[index].generation == me->generation) {
            instance_free_state(pool, me, &snapshot->kept[index].state);
        }
    }
}

void instance_discard(Pool *pool, Instance *me) {
    const Fmi *fmi = pool->settings.fmi;

    free_states(pool, me);
    if (me->phase == PHASE_STEPPING || me->phase == PHASE_ENDED) {
        instance_judge(me, fmi->terminate(me->library, me->component));
    }
    if (me->phase != PHASE_DEAD) {
        mutex_lock(pool->making);
        fmi->free_instance(me->library, me->component);
        mutex_unlock(pool->making);
    } else if (fmi->drop != NULL && me->component != NULL) {
        mutex_lock(pool->making);
        fmi->drop(me->library, me->component);
        mutex_unlock(pool->making);
    }
    floats_restore_if_seen(&pool->floats);
    me->component = NULL;
    me->phase = PHASE_DEAD;
    me->generation++;
    if (pool->start_ids != NULL) {
        pool->start_ids[index_of(pool, me)] = 0;
    }
    me->unsavable = false;
    log_forget(&pool->log, index_of(pool, me));
}

/* A private library may be loaded again. This clears whatever Fatal left in its globals. */
static void reload_private_library(Pool *pool, Instance *me) {
    const Settings *s = &pool->settings;
    char unused[256];

    if (s->private_libraries) {
        copy_leave(pool, me);
        pool_unload(pool, index_of(pool, me));
        if (!pool_load(pool, index_of(pool, me), unused, sizeof unused)) {
            pool_unload(pool, index_of(pool, me));
        }
    }
    floats_restore(&pool->floats); /* loading a library runs code, too */
}

/* Some FMUs refuse an instance after hundreds, because they run out of something that is never given
 * back. */
static bool build_with_copy(Pool *pool, Instance *me) {
    bool is_new = false;

    while (!is_new && !atomic_get(&pool->copies_in_vain) && copy_take(pool, me, &is_new)) {
        if (instance_build(pool, me)) {
            if (is_new && atomic_add(&pool->copies_used, 1) == 0) {
                log_tell(&pool->log, index_of(pool, me),
                         "the FMU refused a further instance; a fresh copy of its library makes it");
            }
            return true;
        }
    }
    if (is_new) {
        atomic_set(&pool->copies_in_vain, 1);
        copy_leave(pool, me);
    }
    return false;
}

static bool build_again(Pool *pool, Instance *me) {
    if (instance_build(pool, me)) {
        atomic_set(&pool->copies_in_vain, 0);
        return true;
    }
    return build_with_copy(pool, me);
}

static Status rebuild(Pool *pool, Instance *me) {
    const bool was_dead = me->phase == PHASE_DEAD;

    instance_discard(pool, me);
    if (was_dead || pool->settings.reloads) {
        reload_private_library(pool, me);
    }
    const bool loaded = me->library->functions != NULL;
    if (loaded && build_again(pool, me)) {
        return STATUS_OK;
    }
    Failure *failure = failure_note(me,
                                    loaded ? "the FMU refused to be instantiated anew"
                                           : "the FMU's library cannot be loaded anew",
                                    -1);
    if (failure != NULL) {
        failure->said = log_said(&pool->log, index_of(pool, me));
    }
    return STATUS_FATAL;
}

static Status replace(Pool *pool, Instance *me) {
    health_of(pool, me)[REPLACEMENTS]++;
    return rebuild(pool, me);
}

Status instance_renew(Pool *pool, Instance *me) {
    if (me->phase == PHASE_DEAD || me->phase == PHASE_INSTANTIATED) {
        return STATUS_OK;
    }
    if (me->phase != PHASE_STEPPING && instance_rebuild_to_hear(pool, me)) {
        return STATUS_OK;
    }
    const bool loud = me->hearing == HEARING_ALL && !pool->settings.logging;
    return loud || pool->settings.rebuilds ? rebuild(pool, me) : STATUS_OK;
}

/* If parts of a system are made anew, their states end, and nothing else is made meanwhile. */
static Status reset(Pool *pool, Instance *me) {
    const bool renews = pool->settings.renews;

    if (renews) {
        free_states(pool, me);
        me->generation++;
        mutex_lock(pool->making);
    } else {
        instance_begin_turn(pool);
    }
    const Status status = pool->settings.fmi->reset(me->library, me->component);
    if (renews) {
        mutex_unlock(pool->making);
    } else {
        instance_end_turn(pool);
    }
    floats_restore_if_seen(&pool->floats);
    return status;
}

Status instance_return_to_start(Pool *pool, Instance *me) {
    if (me->phase == PHASE_INSTANTIATED) {
        return STATUS_OK;
    }
    if (me->phase != PHASE_DEAD) {
        const Status status = reset(pool, me);
        if (status <= STATUS_WARNING) {
            me->phase = PHASE_INSTANTIATED;
            return STATUS_OK;
        }
        instance_judge(me, status);
    }
    return replace(pool, me);
}

Status instance_save(Pool *pool, Instance *me, void **state) {
    *state = NULL;
    const Status status = pool->settings.fmi->get_state(me->library, me->component, state);
    floats_restore_if_seen(&pool->floats);
    return status > STATUS_WARNING ? instance_fail(pool, me, "saving the FMU state", status)
                                   : status;
}

Status instance_restore(Pool *pool, Instance *me, void *state) {
    if (me->phase == PHASE_DEAD) {
        return instance_refuse(me, "no restore after a fatal error");
    }
    const Status status = pool->settings.fmi->set_state(me->library, me->component, state);
    floats_restore_if_seen(&pool->floats);
    if (status > STATUS_WARNING) {
        instance_fail(pool, me, "restoring the FMU state", status);
        return me->phase == PHASE_DEAD ? STATUS_FATAL : STATUS_ERROR;
    }
    me->phase = PHASE_STEPPING;
    return status;
}
