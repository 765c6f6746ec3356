/* Saved states of systems: those of all parts, and the values of the links. */

#include <stdlib.h>
#include <string.h>

#include "system/system.h"

typedef struct {
    void **states;  /* of the parts; behind the slots */
    double slots[]; /* the inputs, the outputs, and whether the outputs are fresh */
} Saved;

static size_t number_of_slots(const System *s) {
    return s->inputs + s->outputs + 1;
}

static Saved *make(const System *s) {
    const size_t slots = number_of_slots(s);
    Saved *saved = calloc(1, sizeof *saved + slots * sizeof(double) + s->count * sizeof(void *));

    if (saved != NULL) {
        saved->states = (void **)(void *)(saved->slots + slots);
    }
    return saved;
}

static Status free_states(Composite *me, Saved *saved) {
    Status worst = STATUS_OK;

    for (size_t i = 0; i < me->system->count; i++) {
        if (saved->states[i] != NULL && !me->parts.dead[i]) {
            const Status status = part_judge(
                me, i, me->system->parts[i].fmi->free_state(
                           &me->libraries[i], me->components[i], &saved->states[i]));
            worst = status > worst ? status : worst;
        }
    }
    free(saved);
    return worst;
}

static void keep_slots(const Composite *me, Saved *saved) {
    const System *s = me->system;

    memcpy(saved->slots, me->inputs, s->inputs * sizeof(double));
    memcpy(saved->slots + s->inputs, me->outputs, s->outputs * sizeof(double));
    saved->slots[s->inputs + s->outputs] = me->is_fresh ? 1.0 : 0.0;
}

static Status get_all(Composite *me, Saved *saved) {
    Status status = STATUS_OK;

    for (size_t i = 0; i < me->system->count && status <= STATUS_WARNING; i++) {
        const Fmi *fmi = me->system->parts[i].fmi;
        status = fmi->get_state == NULL
                     ? STATUS_ERROR
                     : fmi->get_state(&me->libraries[i], me->components[i],
                                      &saved->states[i]);
        status = part_judge(me, i, status);
    }
    return status;
}

/* Always makes a new state. */
Status system_get_state(const Library *library, void *component, void **state) {
    Composite *me = component;
    Saved *saved = make(me->system);

    (void)library;
    me->blamed = NULL;
    if (saved == NULL) {
        return STATUS_ERROR;
    }
    const Status status = get_all(me, saved);
    keep_slots(me, saved);
    if (status > STATUS_WARNING) {
        free_states(me, saved);
        return status;
    }
    *state = saved;
    return status;
}

Status system_set_state(const Library *library, void *component, void *state) {
    Composite *me = component;
    const System *s = me->system;
    const Saved *saved = state;
    Status status = STATUS_OK;

    (void)library;
    me->blamed = NULL;
    for (size_t i = 0; i < s->count && status <= STATUS_WARNING; i++) {
        me->parts.started[i] = true;
        status = part_judge(me, i, s->parts[i].fmi->set_state(&me->libraries[i],
                                                              me->components[i],
                                                              saved->states[i]));
    }
    memcpy(me->inputs, saved->slots, s->inputs * sizeof(double));
    memcpy(me->outputs, saved->slots + s->inputs, s->outputs * sizeof(double));
    me->is_fresh = saved->slots[s->inputs + s->outputs] != 0.0;
    return status;
}

Status system_free_state(const Library *library, void *component, void **state) {
    (void)library;
    const Status status = free_states(component, *state);
    *state = NULL;
    return status;
}

/* Serialized: the slots; then for each part the number of its bytes, and these. */

static size_t size_of_part(Composite *me, const Saved *saved, size_t index) {
    const Fmi *fmi = me->system->parts[index].fmi;
    const size_t size = fmi->state_size == NULL
                            ? 0
                            : fmi->state_size(&me->libraries[index],
                                              me->components[index], saved->states[index]);

    floats_restore_if_seen(me->floats);
    return size;
}

size_t system_state_size(const Library *library, void *component, void *state) {
    Composite *me = component;
    size_t sum = number_of_slots(me->system) * sizeof(double);

    (void)library;
    for (size_t i = 0; i < me->system->count; i++) {
        const size_t size = size_of_part(me, state, i);
        if (size == 0) {
            return 0;
        }
        sum += sizeof(uint64_t) + size;
    }
    return sum;
}

Status system_serialize(const Library *library, void *component, void *state, char *bytes,
                        size_t size) {
    Composite *me = component;
    const Saved *saved = state;
    const size_t slots = number_of_slots(me->system) * sizeof(double);
    char *place = bytes + slots;
    Status status = STATUS_OK;

    (void)library;
    me->blamed = NULL;
    memcpy(bytes, saved->slots, slots);
    for (size_t i = 0; i < me->system->count && status <= STATUS_WARNING; i++) {
        const uint64_t own = size_of_part(me, saved, i);
        if (own + sizeof own > size - (size_t)(place - bytes)) {
            return STATUS_ERROR;
        }
        memcpy(place, &own, sizeof own);
        place += sizeof own;
        status = part_judge(me, i, me->system->parts[i].fmi->serialize(
                                       &me->libraries[i], me->components[i],
                                       saved->states[i], place, own));
        place += own;
    }
    return status;
}

/* Moves on to the bytes of the next part; returns NULL if there are not so many. */
static const char *next_part(const char **place, const char *end, uint64_t *size) {
    if ((size_t)(end - *place) < sizeof *size) {
        return NULL;
    }
    memcpy(size, *place, sizeof *size);
    const char *bytes = *place + sizeof *size;
    if ((uint64_t)(end - bytes) < *size) {
        return NULL;
    }
    *place = bytes + *size;
    return bytes;
}

static Status read_parts(Composite *me, Saved *saved, const char *place, const char *end) {
    Status status = STATUS_OK;

    for (size_t i = 0; i < me->system->count && status <= STATUS_WARNING; i++) {
        const Fmi *fmi = me->system->parts[i].fmi;
        uint64_t size = 0;
        const char *bytes = next_part(&place, end, &size);
        if (bytes == NULL || fmi->deserialize == NULL) {
            return STATUS_ERROR;
        }
        status = part_judge(me, i, fmi->deserialize(&me->libraries[i], me->components[i],
                                                    bytes, size, &saved->states[i]));
    }
    return place == end ? status : STATUS_ERROR;
}

Status system_deserialize(const Library *library, void *component, const char *bytes, size_t size,
                          void **state) {
    Composite *me = component;
    const size_t slots = number_of_slots(me->system) * sizeof(double);
    Saved *saved = size < slots ? NULL : make(me->system);

    (void)library;
    me->blamed = NULL;
    if (saved == NULL) {
        return STATUS_ERROR;
    }
    memcpy(saved->slots, bytes, slots);
    const Status status = read_parts(me, saved, bytes + slots, bytes + size);
    if (status > STATUS_WARNING) {
        free_states(me, saved);
        return status;
    }
    *state = saved;
    return status;
}
