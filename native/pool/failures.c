/* Failures of instances: their statuses, messages and values; health counters. */

#include "pool/failures.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static char *copy_text(const char *text) {
    const size_t size = text == NULL ? 0 : strlen(text) + 1;
    char *copy = size == 0 ? NULL : malloc(size);
    if (copy != NULL) {
        memcpy(copy, text, size);
    }
    return copy;
}

static double *copy_values(const double *values, size_t count) {
    double *copy = values == NULL ? NULL : malloc(count * sizeof *copy);
    if (copy != NULL) {
        memcpy(copy, values, count * sizeof *copy);
    }
    return copy;
}

void failure_drop(Instance *me) {
    if (me->failure != NULL) {
        free(me->failure->said);
        free(me->failure->values);
        free(me->failure);
        me->failure = NULL;
    }
}

Failure *failure_note(Instance *me, const char *doing, int status) {
    failure_drop(me);
    me->failure = calloc(1, sizeof *me->failure);
    if (me->failure != NULL) {
        me->failure->doing = doing;
        me->failure->status = status;
        me->failure->time = NAN;
        me->failure->reference = UINT32_MAX;
    }
    return me->failure;
}

Status instance_judge(Instance *me, Status status) {
    if (status == STATUS_FATAL) {
        me->phase = PHASE_DEAD;
    } else if (status == STATUS_ERROR) {
        me->phase = PHASE_FAILED;
    }
    return status;
}

Status instance_note_not_finite(Instance *me, const char *what, const double *values,
                                size_t count) {
    Failure *failure = failure_note(me, what, -1);
    if (failure != NULL) {
        failure->values = copy_values(values, count);
        failure->number_of_values = count;
    }
    return STATUS_NOT_FINITE;
}

/* Health */

void health_count_fault(const Pool *pool, const Instance *me, Status status) {
    if (status == STATUS_DISCARD) {
        health_of(pool, me)[DISCARDS]++;
    } else if (status == STATUS_ERROR) {
        health_of(pool, me)[ERRORS]++;
    } else if (status == STATUS_FATAL) {
        health_of(pool, me)[FATALS]++;
    } else if (status == STATUS_NOT_FINITE) {
        health_of(pool, me)[NOT_FINITE]++;
    }
}

void health_count_steps(const Pool *pool, Instance *me) {
    health_of(pool, me)[STEPS] += me->steps - me->counted;
    me->counted = me->steps;
}

static const char *part_that_failed(const Pool *pool, const Instance *me) {
    const Fmi *fmi = pool->settings.fmi;
    return fmi->blamed == NULL || me->component == NULL ? NULL : fmi->blamed(me->component);
}

Status instance_fail(Pool *pool, Instance *me, const char *doing, Status status) {
    Failure *failure = failure_note(me, doing, status);
    if (failure != NULL) {
        failure->said = log_said(&pool->log, index_of(pool, me));
        failure->part = part_that_failed(pool, me);
    }
    return instance_judge(me, status);
}

Status instance_refuse(Instance *me, const char *reason) {
    failure_note(me, reason, -1);
    return me->phase == PHASE_DEAD ? STATUS_FATAL : STATUS_ERROR;
}

bool pool_failure(Pool *pool, size_t index, Failure *copy) {
    const Failure *failure = pool->instances[index].failure;

    if (failure != NULL) {
        *copy = *failure;
        copy->said = copy_text(failure->said);
        copy->values = copy_values(failure->values, failure->number_of_values);
    }
    return failure != NULL;
}

void pool_count_steps(Pool *pool) {
    for (size_t i = 0; i < pool->settings.count; i++) {
        health_count_steps(pool, &pool->instances[i]);
    }
}
