/* A capacitor that is charged by a clocked source through a resistor, and discharged by a switch as
   soon as its voltage reaches a limit. Duty cycle and limit are inputs or parameters. */

#include "exchange.h"

const size_t STATES = 1, INDICATORS = 1;

enum { VOLTAGE, DER_VOLTAGE, DUTY, LIMIT, SOURCE, DISCHARGES, PERIOD, TAU };

void model_start(Model *me) {
    me->v[DUTY] = 0.5;
    me->v[LIMIT] = 0.8;
    me->v[PERIOD] = 0.1;
    me->v[TAU] = 0.3;
}

void model_initialize(Model *me) {
    me->v[SOURCE] = 1.0;
    me->next_event = me->time + me->v[DUTY] * me->v[PERIOD];
}

void model_rates(Model *me) {
    me->v[DER_VOLTAGE] = (me->v[SOURCE] - me->v[VOLTAGE]) / me->v[TAU];
}

void model_indicators(const Model *me, double *z) {
    z[0] = me->v[LIMIT] - me->v[VOLTAGE];
}

void model_event(Model *me) {
    if (me->time >= me->next_event) {
        const double part = me->v[SOURCE] > 0.0 ? 1.0 - me->v[DUTY] : me->v[DUTY];
        me->v[SOURCE] = 1.0 - me->v[SOURCE];
        me->next_event += part * me->v[PERIOD];
    }
    if (me->v[VOLTAGE] >= me->v[LIMIT]) {
        me->v[VOLTAGE] = 0.0;
        me->v[DISCHARGES]++;
        me->again = true;
    }
}
