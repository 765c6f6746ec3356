/* x' = u - k x, with intermediate updates at both ends of each internal step (FMI 3.0). */

#include "exchange.h"

#include <pthread.h>

const size_t STATES = 1, INDICATORS = 0;

/* y: jumps with the input; calls: how many updates were made; tentative: whether this is no accepted step */
enum { X, DER_X, U, K, MISCHIEF, Y, CALLS, TENTATIVE };

/* What else the model does, in fmugym's tests. */
enum {
    NOTHING,
    TENTATIVE_POINTS, /* also tells outputs of steps that it does not accept */
    AFTER_THE_STEP,
    BEFORE_THE_STEP,
    BACKWARDS,
    NO_TIME,
    IN_A_THREAD,
    IN_AN_UPDATE,
    NO_GET,
    NO_SET,
    NO_INPUTS, /* never asks for them */
    NO_OUTPUTS, /* never tells them */
    FOR_ANOTHER /* passes an environment that is not its own */
};

typedef void Update(void *environment, double time, bool set, bool get, bool finished, bool early,
                    bool *early_requested, double *early_time);

void model_start(Model *me) {
    me->v[X] = me->v[K] = 1.0;
}

static void tell_again(Model *me);

void model_rates(Model *me) {
    if (me->updating && me->v[MISCHIEF] == IN_AN_UPDATE) {
        tell_again(me);
    }
    me->v[DER_X] = me->v[U] - me->v[K] * me->v[X];
    me->v[Y] = me->v[X] + me->v[U] + 1e6 * me->v[TENTATIVE];
}

typedef struct {
    Model *me;
    double time;
    bool set, get, finished;
} Point;

static void tell_again(Model *me) {
    bool early = false;
    double early_time = 0.0;

    me->v[CALLS] += 1.0;
    ((Update *)me->update)(me->environment, me->time, true, true, true, false, &early, &early_time);
}

static void *tell(void *point) {
    const Point *p = point;
    Model *me = p->me;
    bool early = true;
    double early_time = 0.0;
    char *environment = me->environment;

    me->updating = true;
    me->may_set = p->set && me->v[MISCHIEF] != NO_SET;
    me->may_get = p->get && me->v[MISCHIEF] != NO_GET;
    me->v[CALLS] += 1.0;
    environment += me->v[MISCHIEF] == FOR_ANOTHER;
    ((Update *)me->update)(environment, p->time, p->set, p->get, p->finished, true, &early,
                           &early_time);
    if (early) {
        me->stops = true; /* nobody has asked for this */
    }
    me->updating = false;
    return NULL;
}

static void tell_at(Model *me, double time, bool set, bool get, bool finished) {
    Point point = {me, time, set, get, finished};
    pthread_t thread;

    if (me->v[MISCHIEF] == IN_A_THREAD && pthread_create(&thread, NULL, tell, &point) == 0) {
        pthread_join(thread, NULL);
    } else {
        tell(&point);
    }
}

static double odd_time(const Model *me) {
    const double size = me->step_end - me->step_begin;

    switch ((int)me->v[MISCHIEF]) {
    case AFTER_THE_STEP:
        return me->step_end + 0.01 * size;
    case BEFORE_THE_STEP:
        return me->step_begin - 0.01 * size;
    case BACKWARDS:
        return me->time - 0.5 * (me->time - me->step_begin);
    default:
        return NAN;
    }
}

void model_update(Model *me, bool at_end) {
    const int mischief = (int)me->v[MISCHIEF];

    if (me->update == NULL) {
        return;
    }
    if (!at_end && mischief != NO_INPUTS) {
        tell_at(me, me->time, true, false, false);
    }
    if (at_end && mischief != NO_OUTPUTS) {
        tell_at(me, me->time, false, true, true);
    }
    if (at_end && mischief == TENTATIVE_POINTS) {
        me->v[TENTATIVE] = 1.0;
        tell_at(me, me->time, false, true, false);
        me->v[TENTATIVE] = 0.0;
    }
    if (at_end && mischief >= AFTER_THE_STEP && mischief <= NO_TIME) {
        tell_at(me, odd_time(me), true, true, true);
    }
}
