/* Counts the seconds by time events and asks to stop after ten. It has no state. */

#include "exchange.h"

const size_t STATES = 0, INDICATORS = 0;

enum { COUNT, PERIOD, LAST };

void model_start(Model *me) {
    me->v[PERIOD] = 1.0;
    me->v[LAST] = 10.0;
}

void model_initialize(Model *me) {
    me->next_event = me->time + me->v[PERIOD];
    me->stop = me->time + me->v[LAST];
}

void model_rates(Model *me) {
}

void model_event(Model *me) {
    if (me->time >= me->next_event) {
        me->v[COUNT]++;
        me->next_event += me->v[PERIOD];
    }
}
