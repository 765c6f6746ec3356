/* Robertson's chemical kinetics: Hairer, Wanner, Solving Ordinary Differential Equations II,
   section IV.1. */

#include "exchange.h"

const size_t STATES = 3, INDICATORS = 0;

enum { Y1, Y2, Y3, DER_Y1, DER_Y2, DER_Y3 };

void model_start(Model *me) {
    me->v[Y1] = 1.0;
}

void model_rates(Model *me) {
    double *v = me->v;

    v[DER_Y1] = -0.04 * v[Y1] + 1e4 * v[Y2] * v[Y3];
    v[DER_Y3] = 3e7 * v[Y2] * v[Y2];
    v[DER_Y2] = -v[DER_Y1] - v[DER_Y3];
}

double model_partial(const Model *me, size_t unknown, size_t known) {
    const double *v = me->v;
    const double first[] = {-0.04, 1e4 * v[Y3], 1e4 * v[Y2]}, third[] = {0.0, 6e7 * v[Y2], 0.0};

    switch (unknown) {
    case DER_Y1:
        return first[known];
    case DER_Y2:
        return -first[known] - third[known];
    default:
        return third[known];
    }
}
