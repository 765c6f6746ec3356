/* x1'' = mu (1 - x1^2) x1' - x1 */

#include "exchange.h"

const size_t STATES = 2, INDICATORS = 0;

enum { X1, X2, DER_X1, DER_X2, MU };

void model_start(Model *me) {
    me->v[X1] = 2.0;
    me->v[MU] = 1.0;
}

void model_rates(Model *me) {
    me->v[DER_X1] = me->v[X2];
    me->v[DER_X2] = me->v[MU] * ((1.0 - me->v[X1] * me->v[X1]) * me->v[X2]) - me->v[X1];
}

double model_partial(const Model *me, size_t unknown, size_t known) {
    const double *v = me->v;

    if (unknown == DER_X1) {
        return known == X2;
    }
    return known == X1 ? -2.0 * v[MU] * v[X1] * v[X2] - 1.0 : v[MU] * (1.0 - v[X1] * v[X1]);
}
