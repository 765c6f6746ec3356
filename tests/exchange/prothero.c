/* The equation of Prothero and Robinson, x' = -k (x - cos t) - sin t, with the solution cos t for
   every k; stiff if k is large. */

#include "exchange.h"

const size_t STATES = 1, INDICATORS = 0;

enum { X, DER_X, K };

void model_start(Model *me) {
    me->v[X] = me->v[K] = 1.0;
}

void model_rates(Model *me) {
    me->v[DER_X] = -me->v[K] * (me->v[X] - cos(me->time)) - sin(me->time);
}

double model_partial(const Model *me, size_t unknown, size_t known) {
    return -me->v[K];
}
