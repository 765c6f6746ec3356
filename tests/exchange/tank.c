/* A tank that empties: x' = u - sqrt(x). It discards a state below 0, and counts that. */

#include "exchange.h"

const size_t STATES = 1, INDICATORS = 0;

enum { X, DER_X, U, DISCARDS };

void model_start(Model *me) {
    me->v[X] = 0.01;
}

void model_rates(Model *me) {
    if (me->v[X] < 0.0) {
        me->v[DISCARDS]++;
        me->status = DISCARD;
    } else {
        me->v[DER_X] = me->v[U] - sqrt(me->v[X]);
    }
}
