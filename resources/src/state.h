/* FMU states: saving, restoring and serializing. */

#ifndef STATE_H
#define STATE_H

#include "types.h"

Status get_state(const Instance *instance, const char *function, void **state);
Status set_state(Instance *instance, const char *function, const void *state);
Status free_state(const Instance *instance, const char *function, void **state);
Status serialized_size(const Instance *instance, const char *function, size_t *size);
Status serialize_state(const Instance *instance, const char *function, const void *state,
                       void *bytes, size_t size);
Status deserialize_state(const Instance *instance, const char *function, const void *bytes,
                         size_t size, void **state);

#endif
