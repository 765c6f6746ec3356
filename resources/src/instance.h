/* Creation, destruction and reset of instances. */

#ifndef INSTANCE_H
#define INSTANCE_H

#include "types.h"

/* Provided by the functions of the FMI version: the GUID or instantiation token. */
extern const char model_token[];

/* Allocates size bytes, which begin with an Instance. Returns NULL without a name or memory. */
Instance *instance_create(size_t size, const char *name);
void instance_free(Instance *instance);

/* Compares a token with the FMU's own. */
bool accepts(const Instance *instance, const char *function, const char *token);

/* Returns to the start values and to the phase after instantiation. */
Status reset(Instance *instance, const char *function);

#endif
