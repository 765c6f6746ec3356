/* A block on a moving belt, held by a spring: it sticks to the belt until the spring pulls more
   than the static friction, and then slips. MODE is -1, 0 (sticking) or 1, the sign of the relative
   velocity. Its energy and the times of its events have closed forms. */

#include "exchange.h"

const size_t STATES = 2, INDICATORS = 2;

enum { X, V, DER_X, DER_V, BELT, STATIC, KINETIC, MODE };

void model_start(Model *me) {
    me->v[BELT] = 0.1;
    me->v[STATIC] = 1.0;
    me->v[KINETIC] = 0.6;
    me->v[V] = 0.1;
}

void model_rates(Model *me) {
    const double mode = me->v[MODE];

    me->v[DER_X] = me->v[V];
    me->v[DER_V] = mode == 0.0 ? 0.0 : -me->v[X] - mode * me->v[KINETIC];
}

void model_indicators(const Model *me, double *z) {
    const bool sticks = me->v[MODE] == 0.0;

    z[0] = sticks ? me->v[STATIC] - fabs(me->v[X]) : 1.0;
    z[1] = sticks ? 1.0 : me->v[MODE] * (me->v[V] - me->v[BELT]);
}

void model_event(Model *me) {
    if (me->v[MODE] == 0.0 && fabs(me->v[X]) >= me->v[STATIC]) {
        me->v[MODE] = me->v[X] > 0.0 ? -1.0 : 1.0;
    } else if (me->v[MODE] != 0.0 && me->v[MODE] * (me->v[V] - me->v[BELT]) <= 0.0 &&
               me->v[MODE] * me->v[DER_V] < 0.0) {
        me->v[MODE] = 0.0;
        me->v[V] = me->v[BELT];
    }
}
