/* How the parts of a system begin episodes, each in its own way.
 *
 * Parts that restore keep their state after an initialization with the same start values as the one
 * before. When these come again, such parts return to it, and the others are initialized with the
 * inputs that they had at its end. */

#include <stdlib.h>
#include <string.h>

#include "system/system.h"

static ResetMethod reset_method_of(const Composite *me, size_t index) {
    const ResetMethod method = me->system->parts[index].reset_method;
    return method == METHOD_RESTORE && me->kept.useless[index] ? METHOD_RESET : method;
}

/* Resets */

static Status reset_part(Composite *me, size_t index) {
    if (!me->parts.started[index]) {
        return STATUS_OK;
    }
    const Status status = part_judge(
        me, index, me->system->parts[index].fmi->reset(&me->libraries[index],
                                                       me->components[index]));
    me->parts.started[index] = status > STATUS_WARNING;
    me->parts.failed[index] = status > STATUS_WARNING;
    return status;
}

static void dismiss(Composite *me, size_t index) {
    const Fmi *fmi = me->system->parts[index].fmi;

    if (!me->parts.failed[index]) {
        part_judge(me, index, fmi->terminate(&me->libraries[index], me->components[index]));
    }
    if (!me->parts.dead[index]) {
        part_free(me, index);
    }
}

/* A part that cannot be made any more is dead, and the pool replaces the whole system. */
static Status renew_part(Composite *me, size_t index) {
    if (!me->parts.started[index]) {
        return STATUS_OK;
    }
    dismiss(me, index);
    const bool reloads =
        me->system->private_libraries && me->system->parts[index].reset_method == METHOD_LIBRARY;
    if (me->parts.dead[index] || (reloads && !part_reload(me, index)) ||
        !part_instantiate(me, index)) {
        return part_judge(me, index, STATUS_FATAL);
    }
    me->parts.started[index] = me->parts.failed[index] = false;
    return me->has_chosen ? part_choose_messages(me, index) : STATUS_OK;
}

/* Parts that restore wait until the start values are known. */
static Status begin_anew(Composite *me, size_t index) {
    if (me->parts.dead[index]) {
        return STATUS_ERROR;
    }
    switch (reset_method_of(me, index)) {
    case METHOD_RESTORE:
        return STATUS_OK;
    case METHOD_RESET:
        return reset_part(me, index);
    default:
        return renew_part(me, index);
    }
}

static Status begin_all_anew(Composite *me) {
    Status worst = STATUS_OK;

    for (size_t i = 0; i < me->system->count; i++) {
        const Status status = begin_anew(me, i);
        worst = status > worst ? status : worst;
    }
    return worst;
}

Status system_reset(const Library *library, void *component) {
    Composite *me = component;

    (void)library;
    me->blamed = NULL;
    return begin_all_anew(me);
}

Status start_reset_restoring(Composite *me) {
    Status status = STATUS_OK;

    me->kept.known = false;
    for (size_t i = 0; i < me->system->count && status <= STATUS_WARNING; i++) {
        if (reset_method_of(me, i) == METHOD_RESTORE) {
            status = me->parts.dead[i] ? STATUS_ERROR : reset_part(me, i);
            me->kept.useless[i] = status > STATUS_WARNING;
        }
    }
    return status;
}

Status start_give_up(Composite *me) {
    me->kept.known = false;
    return begin_all_anew(me);
}

/* What was set before an initialization */

static size_t size_of(const Pending *pending) {
    return sizeof(pending->end) + sizeof(pending->value) +
           (pending->text == NULL ? 0 : strlen(pending->text)) + 1;
}

static char *append(char *place, const void *bytes, size_t size) {
    memcpy(place, bytes, size);
    return place + size;
}

bool start_note(Composite *me, double start_time) {
    KeptStart *kept = &me->kept;
    size_t size = sizeof start_time;

    for (size_t i = 0; i < me->number_pending; i++) {
        size += size_of(&me->pending[i]);
    }
    char *bytes = realloc(kept->wanted, size);
    if (bytes == NULL) {
        return false;
    }
    kept->wanted = bytes;
    kept->size_wanted = size;
    bytes = append(bytes, &start_time, sizeof start_time);
    for (size_t i = 0; i < me->number_pending; i++) {
        const Pending *pending = &me->pending[i];
        const char *text = pending->text == NULL ? "" : pending->text;
        bytes = append(bytes, &pending->end, sizeof pending->end);
        bytes = append(bytes, &pending->value, sizeof pending->value);
        bytes = append(bytes, text, strlen(text) + 1);
    }
    return true;
}

static bool is_as_before(const KeptStart *kept) {
    return kept->size == kept->size_wanted && kept->size > 0 &&
           memcmp(kept->key, kept->wanted, kept->size) == 0;
}

bool start_is_kept(const Composite *me) {
    return me->kept.known && is_as_before(&me->kept);
}

/* Keeping and restoring */

static Status get_state(Composite *me, size_t index) {
    const Fmi *fmi = me->system->parts[index].fmi;
    void **state = &me->kept.states[index];
    const Library *library = &me->libraries[index];
    void *component = me->components[index];

    part_free_state(me, index, state);
    const Status status = part_judge(
        me, index, fmi->get_state == NULL ? STATUS_ERROR : fmi->get_state(library, component, state));

    if (status > STATUS_WARNING) {
        return status;
    }
    const size_t size =
        fmi->state_size == NULL ? 0 : fmi->state_size(library, component, *state);
    floats_restore_if_seen(me->floats);
    return size > me->system->largest_state ? STATUS_DISCARD : status;
}

static Status get_states(Composite *me) {
    Status status = STATUS_OK;

    for (size_t i = 0; i < me->system->count && status <= STATUS_WARNING; i++) {
        if (reset_method_of(me, i) == METHOD_RESTORE) {
            status = get_state(me, i);
            me->kept.useless[i] = status > STATUS_WARNING;
        }
    }
    return status;
}

static void keep_slots(Composite *me) {
    const System *s = me->system;

    memcpy(me->kept.slots, me->inputs, s->inputs * sizeof(double));
    memcpy(me->kept.slots + s->inputs, me->outputs, s->outputs * sizeof(double));
}

static void remember(KeptStart *kept) {
    char *key = kept->key;

    kept->key = kept->wanted;
    kept->size = kept->size_wanted;
    kept->wanted = key;
}

Status start_keep(Composite *me) {
    KeptStart *kept = &me->kept;
    const bool again = kept->stepped && is_as_before(kept);
    Status status = STATUS_OK;

    remember(kept);
    kept->stepped = false;
    if (again) {
        status = get_states(me);
        keep_slots(me);
        kept->known = status <= STATUS_WARNING;
    }
    return status;
}

Status start_restore(Composite *me) {
    const System *s = me->system;
    Status status = STATUS_OK;

    for (size_t i = 0; i < s->count && status <= STATUS_WARNING; i++) {
        if (reset_method_of(me, i) == METHOD_RESTORE) {
            status = me->parts.dead[i]
                         ? STATUS_ERROR
                         : part_judge(me, i, s->parts[i].fmi->set_state(&me->libraries[i],
                                                                        me->components[i],
                                                                        me->kept.states[i]));
            me->parts.failed[i] = me->kept.useless[i] = status > STATUS_WARNING;
        }
    }
    me->kept.stepped = false;
    memcpy(me->inputs, me->kept.slots, s->inputs * sizeof(double));
    return status;
}

bool start_is_the_same(const Composite *me) {
    const System *s = me->system;
    return memcmp(me->outputs, me->kept.slots + s->inputs, s->outputs * sizeof(double)) == 0;
}

static bool has_other_outputs(const Composite *me, size_t index) {
    const Component *part = &me->system->parts[index];
    const double *kept = me->kept.slots + me->system->inputs + part->first_output;

    return memcmp(me->outputs + part->first_output, kept,
                  part->outputs.count * sizeof(double)) != 0;
}

/* Nothing has been carried since, so that each part has its outputs to itself. */
void start_blame(Composite *me) {
    bool found = false;

    for (size_t i = 0; i < me->system->count; i++) {
        const bool differs = reset_method_of(me, i) == METHOD_RESTORE && has_other_outputs(me, i);
        me->kept.useless[i] |= differs;
        found |= differs;
    }
    for (size_t i = 0; i < me->system->count && !found; i++) {
        me->kept.useless[i] = true;
    }
}
