/* Moves up and down between two limits. It asks for its events after complete steps, and to stop
   after so many turns. It counts the steps. */

#include "exchange.h"

const size_t STATES = 1, INDICATORS = 0;

enum { X, DER_X, TURNS, LAST, SPEED, STEPS };

void model_start(Model *me) {
    me->v[LAST] = 1e9;
    me->v[SPEED] = 1.0;
}

void model_rates(Model *me) {
    me->v[DER_X] = me->v[SPEED];
}

static bool is_beyond(const Model *me) {
    return me->v[SPEED] > 0.0 ? me->v[X] > 0.95 : me->v[X] < 0.05;
}

void model_complete(Model *me) {
    me->v[STEPS]++;
    me->wants_event = is_beyond(me);
    me->stops = me->v[TURNS] >= me->v[LAST];
}

void model_event(Model *me) {
    if (is_beyond(me)) {
        me->v[SPEED] *= -1.0;
        me->v[TURNS]++;
    }
}
