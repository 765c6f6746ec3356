/* The values of components in other processes. */

#include "far.h"

#if !defined _WIN32

#include <string.h>

#include "served.h"
#include "texts.h"

/* A list of the part is known by the place of its references. */

static ptrdiff_t group_of(const Access *access, const uint32_t *references) {
    for (size_t i = 0; i < access->number_of_groups; i++) {
        if (access->groups[i].references == references) {
            return (ptrdiff_t)i;
        }
    }
    return -1;
}

static void put_asked(Packet *packet, Type type, const uint32_t *references, size_t count,
                      size_t size) {
    packet_put_size(packet, type);
    packet_put_size(packet, count);
    packet_put_size(packet, size);
    packet_put(packet, references, count * sizeof *references);
}

/* Sets values at once. */
static Status set_now(Far *me, Type type, const uint32_t *references, size_t count,
                      const void *values, size_t size) {
    far_begin(me);
    put_asked(&me->host->out, type, references, count, size);
    packet_put(&me->host->out, values, size * value_size(me->part->fmi, type));
    const Status status = far_ask(me, ASK_SET);
    far_end(me);
    return status;
}

Status far_set_waiting(Far *me) {
    const Access *inputs = &me->part->inputs;
    const uint32_t waiting = me->waiting;
    Status status = STATUS_OK;

    me->waiting = 0;
    for (size_t i = 0; waiting >> i != 0 && status <= STATUS_WARNING; i++) {
        const Group *group = &inputs->groups[i];
        if ((waiting >> i & 1) != 0) {
            status = set_now(me, group->type, group->references, group->count,
                             far_input_values(me, i), group->size);
        }
    }
    return status;
}

Status far_set(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, const void *values, size_t size) {
    Far *me = component;
    const ptrdiff_t group = me->steps ? group_of(&me->part->inputs, references) : -1;

    (void)library;
    me->fresh = 0;
    if (group >= 0) {
        memcpy(far_input_values(me, (size_t)group), values,
               far_size_of_group(&me->part->inputs, (size_t)group));
        me->waiting |= 1u << group;
        return STATUS_OK;
    }
    const Status status = far_set_waiting(me);
    return status > STATUS_WARNING ? status
                                   : set_now(me, type, references, count, values, size);
}

Status far_get(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, void *values, size_t size) {
    Far *me = component;
    const ptrdiff_t group = group_of(&me->part->outputs, references);

    (void)library;
    if (group >= 0 && (me->fresh >> group & 1) != 0) {
        memcpy(values, far_output_values(me, (size_t)group),
               far_size_of_group(&me->part->outputs, (size_t)group));
        return (Status)me->got[group];
    }
    Status status = far_set_waiting(me);
    if (status > STATUS_WARNING) {
        return status;
    }
    far_begin(me);
    put_asked(&me->host->out, type, references, count, size);
    status = far_ask(me, ASK_GET);
    if (status <= STATUS_WARNING) {
        packet_take(&me->host->in, values, size * value_size(me->part->fmi, type));
    }
    far_end(me);
    return status;
}

Status far_set_string(const Library *library, void *component, uint32_t reference,
                         const char *text) {
    Far *me = component;

    (void)library;
    me->fresh = 0;
    far_begin(me);
    packet_put_size(&me->host->out, reference);
    packet_put_text(&me->host->out, text);
    const Status status = far_ask(me, ASK_SET_STRING);
    far_end(me);
    return status;
}

Status far_get_string(const Library *library, void *component, uint32_t reference,
                         const char **text) {
    Far *me = component;
    Status status = far_set_waiting(me);

    (void)library;
    if (status > STATUS_WARNING) {
        return status;
    }
    far_begin(me);
    packet_put_size(&me->host->out, reference);
    status = far_ask(me, ASK_GET_STRING);
    if (status <= STATUS_WARNING) {
        *text = text_with(text_number(packet_take_text(&me->host->in))); /* the packet changes */
        status = *text == NULL ? STATUS_ERROR : status; /* no room for another one */
    }
    far_end(me);
    return status;
}

#endif
