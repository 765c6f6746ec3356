/* The table of functions by which a system looks like one FMU. */

#include "system/system.h"

/* Systems are loaded by system_load. */
static bool bind(Library *library, char *error, size_t size) {
    (void)library;
    (void)error;
    (void)size;
    return true;
}

static const char *blamed(const void *component) {
    const Composite *me = component;
    return me->blamed;
}

const Fmi composite = {
    .boolean_size = sizeof(bool),
    .bind = bind,
    .instantiate = system_instantiate,
    .choose_messages = system_choose_messages,
    .initialize = system_initialize,
    .do_step = system_do_step,
    .exchange = system_exchange,
    .get = system_get,
    .set = system_set,
    .set_string = system_set_string,
    .reset = system_reset,
    .terminate = system_terminate,
    .free_instance = system_free,
    .get_state = system_get_state,
    .set_state = system_set_state,
    .free_state = system_free_state,
    .state_size = system_state_size,
    .serialize = system_serialize,
    .deserialize = system_deserialize,
    .blamed = blamed,
    .drop = system_drop,
};
