/* Getting and setting the variables of a system. */

#include <math.h>
#include <stdlib.h>

#include "system.h"

Status part_judge(Composite *me, size_t index, Status status) {
    floats_restore_if_seen(me->floats);
    if (status > STATUS_WARNING && status != STATUS_TERMINATED) {
        me->blamed = me->blamed == NULL ? me->system->parts[index].label : me->blamed;
        me->parts.dead[index] |= status == STATUS_FATAL;
        me->parts.failed[index] |= status == STATUS_ERROR;
    }
    return status;
}

static Access access_of_one(const Component *part, Type type, const uint32_t *reference,
                            uint32_t *position) {
    Access access = {.fmi = part->fmi,
                     .count = 1,
                     .width = 1,
                     .number_of_groups = 1,
                     .direct = type == TYPE_FLOAT64,
                     .start_time = -1};

    *position = 0;
    access.groups[0] = (Group){.type = type,
                               .count = 1,
                               .size = 1,
                               .references = (uint32_t *)reference,
                               .offsets = position,
                               .listed = {1, position, position}};
    return access;
}

Status part_get(Composite *me, size_t index, Type type, const uint32_t *reference, double *value) {
    uint32_t position;
    const Access one = access_of_one(&me->system->parts[index], type, reference, &position);

    return part_judge(me, index, access_get(&one, &me->libraries[index],
                                            me->components[index], value, me->typed,
                                            me->floats));
}

Status part_set(Composite *me, size_t index, Type type, const uint32_t *reference, double value) {
    uint32_t position;
    const Access one = access_of_one(&me->system->parts[index], type, reference, &position);

    return part_judge(me, index, access_set(&one, &me->libraries[index],
                                            me->components[index], &value, me->typed,
                                            me->floats));
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

Status route_carry(Composite *me, const Route *route, double value, double *carried) {
    if (!isfinite(value)) {
        me->blamed = me->system->parts[route->source_part].not_finite;
        return STATUS_NOT_FINITE;
    }
    *carried = scaled(route->scale, value);
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
        status = part_get(me, end->part, end->type, &end->reference, value);
    }
    *value = scaled(end->scale, *value);
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
    me->pending[me->number_pending++] = (Pending){end, value, text};
    return STATUS_OK;
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
    return part_set(me, end->part, end->type, &end->reference, value);
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

    (void)library;
    const End *end = first_end(me, reference);
    return end == NULL ? STATUS_ERROR : note(me, end, 0.0, text);
}

Status system_get_string(const Library *library, void *component, uint32_t reference,
                         const char **text) {
    Composite *me = component;

    (void)library;
    me->blamed = NULL;
    const End *end = first_end(me, reference);
    if (end == NULL) {
        return STATUS_ERROR;
    }
    const Fmi *fmi = me->system->parts[end->part].fmi;
    const Status status = fmi->get_string(&me->libraries[end->part], me->components[end->part],
                                          end->reference, text);
    floats_restore_if_seen(me->floats);
    return part_judge(me, end->part, status);
}
