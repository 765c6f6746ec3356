/* x' = cos(t) (x + u): with a constant u, x + u grows by exp(sin(t2) - sin(t1)) from t1 to t2. */

#include "exchange.h"

const size_t STATES = 1, INDICATORS = 0;

enum { X, DER_X, U };

void model_start(Model *me) {
    me->v[X] = 1.0;
}

void model_rates(Model *me) {
    me->v[DER_X] = cos(me->time) * (me->v[X] + me->v[U]);
}
