/* The models as FMUs of FMI 1.0 for model exchange, which has no modes: events and new values of
   inputs come at any time. */

#include "exchange.h"

#include <stdlib.h>
#include <string.h>

#ifndef SPARSE
#define SPARSE 0
#endif

typedef struct {
    void *logger, *allocate, *release;
} Callbacks;

typedef struct {
    char converged, references_changed, states_changed, terminate, has_next;
    double next;
} EventInfo;

void *Model_fmiInstantiateModel(const char *name, const char *token, Callbacks callbacks,
                                char logging) {
    return core_new(name, true, callbacks.logger, NULL);
}

void Model_fmiFreeModelInstance(Model *me) {
    free(me);
}

/* Before initialization this is the start time. */
int Model_fmiSetTime(Model *me, double time) {
    if (me->mode == INSTANTIATED) {
        me->time = time;
        return OK;
    }
    return core_set_time(me, time);
}

/* With SPARSE, tells nothing where nothing has happened, as some tools do. */
static int settle(Model *me, EventInfo *info, bool first) {
    const Model before = *me;
    int status = core_update(me);

    while (status == OK && me->again) {
        status = core_update(me);
    }
    const bool changed = me->stops || me->next_event != before.next_event ||
                         memcmp(me->v, before.v, sizeof me->v) != 0;
    if (SPARSE && !first && !changed) {
        return status != OK ? status : core_enter_continuous(me);
    }
    *info = (EventInfo){.converged = 1,
                        .terminate = me->stops,
                        .states_changed = 1,
                        .has_next = me->next_event < INFINITY,
                        .next = me->next_event};
    return status != OK || me->stops ? status : core_enter_continuous(me);
}

int Model_fmiInitialize(Model *me, char has_tolerance, double tolerance, EventInfo *info) {
    const int status = core_enter_initialization(me, me->time);

    return status != OK || core_exit_initialization(me) != OK ? ERROR : settle(me, info, true);
}

int Model_fmiEventUpdate(Model *me, char intermediate_results, EventInfo *info) {
    const int status = core_enter_events(me);

    return status != OK ? status : settle(me, info, false);
}

int Model_fmiTerminate(Model *me) {
    me->mode = TERMINATED;
    return OK;
}

int Model_fmiGetReal(Model *me, const unsigned *references, size_t count, double *values) {
    return core_get(me, references, count, values);
}

int Model_fmiSetReal(Model *me, const unsigned *references, size_t count, const double *values) {
    const int mode = me->mode;

    me->mode = mode == CONTINUOUS ? EVENT : mode;
    const int status = core_set(me, references, count, values);
    me->mode = mode;
    return status;
}

int Model_fmiCompletedIntegratorStep(Model *me, char *event) {
    const int status = core_complete(me);

    *event = me->wants_event;
    return status;
}

int Model_fmiSetContinuousStates(Model *me, const double *x, size_t count) {
    return core_set_states(me, x, count);
}

int Model_fmiGetContinuousStates(Model *me, double *x, size_t count) {
    return core_get_states(me, x, count);
}

int Model_fmiGetDerivatives(Model *me, double *rates, size_t count) {
    return core_rates(me, rates, count);
}

int Model_fmiGetEventIndicators(Model *me, double *z, size_t count) {
    return core_indicators(me, z, count);
}

int Model_fmiGetNominalContinuousStates(Model *me, double *x, size_t count) {
    return core_nominals(me, x, count);
}

const char *Model_fmiGetVersion(void) {
    return "1.0";
}

const char *Model_fmiGetTypesPlatform(void) {
    return "standard32";
}

const char *Model_fmiGetModelTypesPlatform(void) {
    return "standard32";
}

#define STUB(name)                                                                                 \
    int name(void) {                                                                               \
        return ERROR;                                                                              \
    }
#include STUBS
