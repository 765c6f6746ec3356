/* Getting and setting the variables of a system. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "system/system.h"

Status part_judge(Composite *me, size_t index, Status status) {
    floats_restore_if_seen(me->floats);
    if (status > STATUS_WARNING && status != STATUS_TERMINATED) {
        me->blamed = me->blamed == NULL ? me->system->parts[index].label : me->blamed;
        me->parts.dead[index] |= status == STATUS_FATAL;
        me->parts.failed[index] |= status == STATUS_ERROR;
    }
    return status;
}

static Status get_variable(Composite *me, size_t index, Type type, const Element *element,
                           double *values, void *typed) {
    return part_judge(me, index, variable_get(me->system->parts[index].fmi, &me->libraries[index],
                                              me->components[index], type, element, values, typed,
                                              me->floats));
}

static Status set_variable(Composite *me, size_t index, Type type, const Element *element,
                           const double *values, void *typed) {
    return part_judge(me, index, variable_set(me->system->parts[index].fmi, &me->libraries[index],
                                              me->components[index], type, element, values, typed,
                                              me->floats));
}

Status part_get(Composite *me, size_t index, Type type, const Element *element, double *values) {
    return get_variable(me, index, type, element, values, me->typed);
}

Status part_set(Composite *me, size_t index, Type type, const Element *element,
                const double *values) {
    return set_variable(me, index, type, element, values, me->typed);
}

/* Arrays without slots may be longer than the scratch memory. */
typedef struct {
    double *values, *typed;
} Room;

static bool make_room(const Composite *me, const End *end, Room *room) {
    const size_t size = end->element.size;

    *room = (Room){me->whole, me->typed};
    if (size > 1) {
        room->values = malloc(2 * size * sizeof(double));
        room->typed = room->values == NULL ? NULL : room->values + size;
    }
    return room->values != NULL;
}

static void leave_room(const Composite *me, Room room) {
    if (room.values != me->whole) {
        free(room.values);
    }
}

static Status end_get(Composite *me, const End *end, double *value) {
    Room room;

    if (!make_room(me, end, &room)) {
        return STATUS_ERROR;
    }
    const Status status =
        get_variable(me, end->part, end->type, &end->element, room.values, room.typed);
    *value = room.values[end->element.place];
    leave_room(me, room);
    return status;
}

Status end_set(Composite *me, const End *end, const double *values, Change change) {
    Room room;
    Status status = STATUS_OK;

    if (!make_room(me, end, &room)) {
        return STATUS_ERROR;
    }
    if (values != NULL) {
        memcpy(room.values, values, end->element.size * sizeof(double));
    } else if (end->element.size > 1) {
        status = get_variable(me, end->part, end->type, &end->element, room.values, room.typed);
    }
    if (status <= STATUS_WARNING) {
        change.make(change.context, end, room.values);
        status = set_variable(me, end->part, end->type, &end->element, room.values, room.typed);
    }
    leave_room(me, room);
    return status;
}

Status part_set_inputs(Composite *me, size_t index) {
    const Component *part = &me->system->parts[index];

    if (part->inputs.direct) {
        const Group *group = part->inputs.groups;
        return part->fmi->set(&me->libraries[index], me->components[index], TYPE_FLOAT64,
                              group->references, group->count, me->inputs + part->first_input,
                              group->size);
    }
    return access_set(&part->inputs, &me->libraries[index], me->components[index],
                      me->inputs + part->first_input, me->typed, me->floats);
}

Status part_derive(Composite *me, size_t index, const Derivation *derivation, double *values) {
    const Fmi *fmi = me->system->parts[index].fmi;
    Status status = STATUS_ERROR;

    me->blamed = NULL;
    if (fmi->derive != NULL) {
        status = part_set_inputs(me, index);
    }
    if (status <= STATUS_WARNING) {
        status = fmi->derive(&me->libraries[index], me->components[index], derivation, values);
    }
    return part_judge(me, index, status);
}

Status part_read(Composite *me, size_t index) {
    const Component *part = &me->system->parts[index];

    if (part->outputs.direct) {
        const Group *group = part->outputs.groups;
        return part->fmi->get(&me->libraries[index], me->components[index], TYPE_FLOAT64,
                              group->references, group->count, me->outputs + part->first_output,
                              group->size);
    }
    return access_get(&part->outputs, &me->libraries[index], me->components[index],
                      me->outputs + part->first_output, me->typed, me->floats);
}

Status route_carry(Composite *me, const Route *route, const double *values, double *carried) {
    for (size_t i = 0; i < route->count; i++) {
        if (!isfinite(values[i])) {
            me->blamed = me->system->parts[route->source_part].not_finite;
            return STATUS_NOT_FINITE;
        }
        carried[i] = scaled(route->scale, values[i]);
    }
    return STATUS_OK;
}

Status system_refresh(Composite *me) {
    Status status = STATUS_OK;

    for (size_t i = 0; i < me->system->count && status <= STATUS_WARNING; i++) {
        status = part_judge(me, i, part_read(me, i));
    }
    me->is_fresh = status <= STATUS_WARNING;
    return status;
}

/* NULL if there is no such variable. */
static const End *first_end(const Composite *me, uint32_t reference) {
    const System *s = me->system;
    return reference < s->number_of_variables ? &s->ends[s->first_ends[reference]] : NULL;
}

static Status get_one(Composite *me, uint32_t reference, double *value) {
    const End *end = first_end(me, reference);
    Status status = STATUS_OK;

    if (end == NULL) {
        return STATUS_ERROR;
    }
    if (end->output >= 0 && me->is_fresh) {
        *value = me->outputs[end->output];
    } else if (end->input >= 0) {
        *value = me->inputs[end->input];
    } else {
        status = end_get(me, end, value);
    }
    *value = scaled(end->reading, *value);
    return status;
}

Status system_get(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, void *values, size_t size) {
    Composite *me = component;
    double *numbers = values;
    Status worst = type == TYPE_FLOAT64 ? STATUS_OK : STATUS_ERROR;

    (void)library;
    (void)size;
    me->blamed = NULL;
    for (size_t i = 0; i < count && worst <= STATUS_WARNING; i++) {
        const Status status = get_one(me, references[i], &numbers[i]);
        worst = status > worst ? status : worst;
    }
    return worst;
}

/* Before the initialization, FMUs take values only at a certain point. */
static Status note(Composite *me, const End *end, double value, const char *text) {
    if (me->number_pending == me->room) {
        const size_t room = 2 * me->room + 8;
        Pending *pending = realloc(me->pending, room * sizeof *pending);
        if (pending == NULL) {
            return STATUS_ERROR;
        }
        me->pending = pending;
        me->room = room;
    }
    me->pending[me->number_pending++] = (Pending){end, value, text, false};
    return STATUS_OK;
}

static void put(void *context, const End *end, double *values) {
    values[end->element.place] = *(const double *)context;
}

static Status set_end(Composite *me, const End *end, double value) {
    if (end->input >= 0) {
        me->inputs[end->input] = value;
        return me->is_collecting ? note(me, end, value, NULL) : STATUS_OK;
    }
    if (me->is_collecting) {
        return note(me, end, value, NULL);
    }
    me->is_fresh = false;
    return end_set(me, end, NULL, (Change){put, &value});
}

Status system_set(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, const void *values, size_t size) {
    Composite *me = component;
    const System *s = me->system;
    const double *numbers = values;
    Status worst = type == TYPE_FLOAT64 ? STATUS_OK : STATUS_ERROR;

    (void)library;
    (void)size;
    me->blamed = NULL;
    for (size_t i = 0; i < count && worst <= STATUS_WARNING; i++) {
        if (references[i] >= s->number_of_variables) {
            return STATUS_ERROR;
        }
        const uint32_t begin = s->first_ends[references[i]], end = s->first_ends[references[i] + 1];
        for (uint32_t j = begin; j < end && worst <= STATUS_WARNING; j++) {
            const Status status = set_end(me, &s->ends[j], scaled(s->ends[j].scale, numbers[i]));
            worst = status > worst ? status : worst;
        }
    }
    return worst;
}

Status system_set_string(const Library *library, void *component, uint32_t reference,
                         const char *text) {
    Composite *me = component;
    const System *s = me->system;
    bool good = true;

    (void)library;
    if (reference >= s->number_of_variables) {
        return STATUS_ERROR;
    }
    for (uint32_t i = s->first_ends[reference]; i < s->first_ends[reference + 1] && good; i++) {
        good = note(me, &s->ends[i], 0.0, text) == STATUS_OK;
    }
    return good ? STATUS_OK : STATUS_ERROR;
}
