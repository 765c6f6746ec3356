/* Saved states that the worker of a component keeps, by numbers. */

#include <stdlib.h>

#include "serving.h"

static size_t place_of_state(void *state) {
    for (size_t i = 0; i < served.number_of_states; i++) {
        if (served.states[i] == NULL) {
            served.states[i] = state;
            return i;
        }
    }
    const size_t count = served.number_of_states + 1;
    served.states = serving_memory((void *)served.states, count * sizeof *served.states);
    served.states[count - 1] = state;
    served.number_of_states = count;
    return count - 1;
}

static void **take_state(void) {
    static void *none;
    const size_t number = serving_take_size();

    none = NULL;
    return number < served.number_of_states ? &served.states[number] : &none;
}

void serving_get_state(Instance *me) {
    int64_t number;

    TAKE(&served.in, number);
    const bool again = number >= 0 && (size_t)number < served.number_of_states;
    void *state = again ? served.states[number] : NULL, *before = state;
    const Status status = served.fmi->get_state(&served.library, me->component, &state);
    const bool other = state != before;
    if (again) {
        served.states[number] = state; /* if there is none now, the number is free */
    } else if (state != NULL) {
        number = (int64_t)place_of_state(state);
    }
    if (state == NULL) {
        number = -1;
    }
    serving_answer(status);
    PUT(&served.out, number);
    PUT(&served.out, other);
}

void serving_set_state(Instance *me) {
    serving_answer(served.fmi->set_state(&served.library, me->component, *take_state()));
}

void serving_free_state(Instance *me) {
    void **state = take_state();
    const Status status =
        *state == NULL ? STATUS_OK : served.fmi->free_state(&served.library, me->component, state);

    *state = NULL;
    serving_answer(status);
}

void serving_state_size(Instance *me) {
    const uint64_t size = served.fmi->state_size(&served.library, me->component, *take_state());

    serving_answer(STATUS_OK);
    PUT(&served.out, size);
}

void serving_serialize(Instance *me) {
    void *state = *take_state();
    const size_t size = serving_take_size();
    char *bytes = serving_memory(NULL, size);

    serving_answer(served.fmi->serialize(&served.library, me->component, state, bytes, size));
    packet_put(&served.out, bytes, size);
    free(bytes);
}

void serving_deserialize(Instance *me) {
    size_t size;
    char *bytes = serving_take_copy(&size);
    void *state = NULL;
    int64_t number = -1;

    const Status status =
        served.fmi->deserialize(&served.library, me->component, bytes, size, &state);
    if (state != NULL) {
        number = (int64_t)place_of_state(state);
    }
    serving_answer(status);
    PUT(&served.out, number);
    free(bytes);
}
