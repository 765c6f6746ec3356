/* Equations that solvers cannot manage, or not with every step; KIND says which. Its number of calls
   is kept, and the FMU may take its time for each (DELAY in microseconds). */

#include "exchange.h"

#include <unistd.h>

const size_t STATES = 1, INDICATORS = 1;

enum { X, DER_X, KIND, CALLS, DELAY };
enum { TAME, STIFF, RANDOM, GROWING, FALLING, FAILING_BELOW_0, FAILING_LATER, WITHOUT_SIGN };

void model_start(Model *me) {
    me->v[X] = 0.01;
}

static double some_number(Model *me) {
    unsigned state = (unsigned)me->v[CALLS] * 2654435761u;

    state ^= state >> 15;
    return (double)(state * 2246822519u % 20001u) - 1e4;
}

void model_rates(Model *me) {
    const double x = me->v[X];

    me->v[CALLS]++;
    if (me->v[DELAY] > 0.0) {
        usleep((useconds_t)me->v[DELAY]);
    }
    switch ((int)me->v[KIND]) {
    case STIFF: me->v[DER_X] = -1e9 * x; break;
    case RANDOM: me->v[DER_X] = some_number(me); break;
    case GROWING: me->v[DER_X] = 1e300; break;
    case FALLING: me->v[DER_X] = -1e300 * x; break;
    case FAILING_BELOW_0:
        me->status = x < 0.0 ? ERROR : OK;
        me->v[DER_X] = x < 0.0 ? NAN : -sqrt(x);
        break;
    case FAILING_LATER:
        me->status = me->time > 0.05 ? ERROR : OK;
        me->v[DER_X] = 1.0;
        break;
    default: me->v[DER_X] = 1.0;
    }
}

void model_indicators(const Model *me, double *z) {
    z[0] = me->v[KIND] == WITHOUT_SIGN && me->v[X] > 0.2 ? NAN : 1.0;
}
