/* x' = u - k x */

#include "exchange.h"

const size_t STATES = 1, INDICATORS = 0;

enum { X, DER_X, U, K };

void model_start(Model *me) {
    me->v[X] = me->v[K] = 1.0;
}

void model_rates(Model *me) {
    me->v[DER_X] = me->v[U] - me->v[K] * me->v[X];
}

double model_partial(const Model *me, size_t unknown, size_t known) {
    const double by_state = unknown == X ? 1.0 : -me->v[K], by_input = unknown == X ? 0.0 : 1.0;

    return known == X ? by_state : by_input;
}
