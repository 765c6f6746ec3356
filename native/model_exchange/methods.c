/* The methods of integration by name. */

#include "model_exchange/methods.h"

#include <string.h>

const Method by_fmu = {.name = "by_fmu"};

const Method *method_of(const char *name) {
    static const Method *const methods[] = {&euler, &rk4, &dormand_prince, &rosenbrock,
                                            &by_fmu};

    for (size_t i = 0; i < sizeof methods / sizeof *methods; i++) {
        if (strcmp(methods[i]->name, name) == 0) {
            return methods[i];
        }
    }
    return NULL;
}
