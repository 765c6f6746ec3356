/* Follows the time of day: x' = cos(t) + u. It tells its own time and sin(t), and counts the full
   seconds by time events. */

#include "exchange.h"

const size_t STATES = 1, INDICATORS = 0;

enum { X, DER_X, NOW, SINE, SECONDS, U };

void model_start(Model *me) {
    me->v[X] = 0.0;
}

void model_initialize(Model *me) {
    me->next_event = floor(me->time) + 1.0;
}

void model_rates(Model *me) {
    me->v[DER_X] = cos(me->time) + me->v[U];
    me->v[NOW] = me->time;
    me->v[SINE] = sin(me->time);
}

void model_event(Model *me) {
    if (me->time >= me->next_event) {
        me->v[SECONDS]++;
        me->next_event += 1.0;
    }
}
