#include "methods.h"

#include <string.h>

const Method *method_of(const char *name) {
    static const Method *const methods[] = {&euler, &rk4, &dormand_prince, &rosenbrock};

    for (size_t i = 0; i < sizeof methods / sizeof *methods; i++) {
        if (strcmp(methods[i]->name, name) == 0) {
            return methods[i];
        }
    }
    return NULL;
}
