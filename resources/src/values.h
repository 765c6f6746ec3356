/* Access to variables and to partial derivatives. A call that fails changes nothing. */

#ifndef VALUES_H
#define VALUES_H

#include "types.h"

Status get_reals(Instance *instance, const char *function, const uint32_t references[],
                 size_t number, double values[]);
Status set_reals(Instance *instance, const char *function, const uint32_t references[],
                 size_t number, const double values[]);
Status get_enumerations(const Instance *instance, const char *function,
                        const uint32_t references[], size_t number, Integer values[]);
Status set_enumerations(Instance *instance, const char *function, const uint32_t references[],
                        size_t number, const Integer values[]);

/* Refuses access to variables of a type that the model does not use. */
Status no_such_variables(const Instance *instance, const char *function, size_t number);

/* Differentiates outputs and derivatives with respect to states and inputs. */
Status directional_derivative(Instance *instance, const char *function, const uint32_t unknowns[],
                              size_t number_of_unknowns, const uint32_t knowns[],
                              size_t number_of_knowns, const double seed[], double sensitivity[]);

#endif
