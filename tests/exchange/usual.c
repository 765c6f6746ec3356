/* What a model leaves out: weak functions. */

#include "exchange.h"

#define USUAL __attribute__((weak))

USUAL void model_initialize(Model *me) {
}

USUAL void model_indicators(const Model *me, double *z) {
}

USUAL void model_event(Model *me) {
}

USUAL void model_complete(Model *me) {
}

USUAL double model_partial(const Model *me, size_t unknown, size_t known) {
    return NAN;
}
