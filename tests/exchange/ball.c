/* A ball that loses part of its speed whenever it bounces, and comes to rest. */

#include "exchange.h"

const size_t STATES = 2, INDICATORS = 1;

enum { H, V, DER_H, DER_V, G, E, V_MIN, BOUNCES };

void model_start(Model *me) {
    me->v[H] = 1.0;
    me->v[G] = -9.81;
    me->v[E] = 0.7;
    me->v[V_MIN] = 0.1;
}

void model_rates(Model *me) {
    me->v[DER_H] = me->v[V];
    me->v[DER_V] = me->v[G];
}

void model_indicators(const Model *me, double *z) {
    z[0] = me->v[H];
}

void model_event(Model *me) {
    if (me->v[H] <= 0.0 && me->v[V] < 0.0) {
        me->v[H] = 0.0;
        me->v[V] *= -me->v[E];
        me->v[BOUNCES]++;
        if (me->v[V] < me->v[V_MIN]) {
            me->v[V] = me->v[G] = 0.0;
        }
    }
}
