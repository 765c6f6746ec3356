/* Initialization of a system. All FMUs are in Initialization Mode while values are exchanged: each
 * is initialized inside of the initialization of the one before. FMUs of FMI 1.0 have no such mode.
 * They are initialized when somebody needs their outputs, or at the end. */

#include <string.h>

#include "system/system.h"

typedef struct {
    Composite *me;
    const Experiment *experiment;
    const char **doing;
} Beginning;

/* Where the recursion is. */
typedef struct {
    const Beginning *beginning;
    size_t index;
} Place;

/* Those of the pending values that belong to an array, or to a scalar. */
typedef struct {
    Pending *first, *end;
} Awaiting;

static bool is_of_same_array(const End *one, const End *other) {
    return one->part == other->part && one->type == other->type &&
           one->element.reference == other->element.reference;
}

static void put_pending(void *context, const End *end, double *values) {
    const Awaiting *awaiting = context;

    for (Pending *p = awaiting->first; p < awaiting->end; p++) {
        if (p == awaiting->first || (p->text == NULL && is_of_same_array(p->end, end))) {
            values[p->end->element.place] = p->value;
            p->done = true;
        }
    }
}

/* FMI sets whole arrays: all pending elements of an array are set with the first one, and the
 * others start with what the system says. */
static Status set_pending(Composite *me, size_t index, Pending *pending) {
    const End *end = pending->end;
    const Component *part = &me->system->parts[index];
    Awaiting awaiting = {pending, end->starts == NULL ? pending + 1
                                                      : me->pending + me->number_pending};

    if (pending->text == NULL) {
        const double *slots = end->starts == NULL || end->input < 0
                                  ? end->starts
                                  : me->inputs + end->input - end->element.place;
        return end_set(me, end, slots, (Change){put_pending, &awaiting});
    }
    return part_judge(me, index, part->fmi->set_string(&me->libraries[index],
                                                       me->components[index],
                                                       end->element.reference, pending->text));
}

/* What is set for this simulation wins over what the system says. */
static Status set_starts(void *context) {
    const Place *place = context;
    Composite *me = place->beginning->me;
    const size_t index = place->index;
    const Component *part = &me->system->parts[index];
    const Library *library = &me->libraries[index];
    void *component = me->components[index];

    Status status = part_judge(me, index, access_set(&part->starts, library, component,
                                                     part->start_values, me->typed, me->floats));
    for (size_t i = 0; i < part->number_of_strings && status <= STATUS_WARNING; i++) {
        const PartString *string = &part->strings[i];
        status = part_judge(me, index, part->fmi->set_string(library, component, string->reference,
                                                             string->text));
    }
    for (size_t i = 0; i < me->number_pending && status <= STATUS_WARNING; i++) {
        if (me->pending[i].end->part == index && !me->pending[i].done) {
            status = set_pending(me, index, &me->pending[i]);
        }
    }
    /* an FMU of FMI 1.0 takes no values between these and the end of its initialization */
    return status <= STATUS_WARNING && !part->has_mode
               ? part_judge(me, index, part_set_inputs(me, index))
               : status;
}

static Status begin_from(const Beginning *b, size_t index);

static Status begin_next(void *context) {
    const Place *place = context;
    return begin_from(place->beginning, place->index + 1);
}

static Status initialize_part(const Beginning *b, size_t index, StartValues values) {
    Composite *me = b->me;
    const Component *part = &me->system->parts[index];
    Experiment experiment = *b->experiment;

    experiment.number_of_structural = part->number_of_structural;
    experiment.structural_references = part->structural_references;
    experiment.structural_values = part->structural_values;
    me->parts.started[index] = true;
    const Status status =
        part_judge(me, index, part->fmi->initialize(&me->libraries[index], me->components[index],
                                                    &experiment, values, b->doing));
    me->parts.failed[index] |= status > STATUS_WARNING;
    return status;
}

static Status begin_part(const Beginning *b, size_t index, bool goes_on) {
    Place place = {b, index};
    const StartValues values = {
        .set = set_starts, .context = &place, .exchange = goes_on ? begin_next : NULL};

    return initialize_part(b, index, values);
}

/* Exchanging values */

static Status begin_if_old(const Beginning *b, size_t index) {
    Composite *me = b->me;
    const bool waits = !me->system->parts[index].has_mode && !me->parts.started[index];
    return waits ? begin_part(b, index, false) : STATUS_OK;
}

static Status read_source(const Beginning *b, const Route *route, double *values) {
    Composite *me = b->me;
    const Component *part = &me->system->parts[route->source_part];
    const size_t place = route->source - part->first_output;
    const Element *element = &part->outputs.variables[place];
    Status status = begin_if_old(b, route->source_part);

    if (status <= STATUS_WARNING) {
        status = part_get(me, route->source_part, (Type)part->outputs.types[place], element,
                          me->whole);
    }
    return status > STATUS_WARNING ? status
                                   : route_carry(me, route, me->whole + element->place, values);
}

/* FMI forbids to set inputs with clocks in Initialization Mode: they get their values in steps. */
static bool waits_for_clock(const Component *part, uint32_t reference) {
    for (size_t i = 0; i < part->solving.number_of_clocked; i++) {
        const Clocked *clocked = &part->solving.clocked[i];
        if (clocked->reference == reference && clocked->clock != NO_CLOCK) {
            return true;
        }
    }
    return false;
}

/* An FMU of FMI 1.0 that waits gets the values when it begins. An element of an array is set with
 * the others, which stay as they are. */
static Status write_target(const Beginning *b, const Route *route, const double *values) {
    Composite *me = b->me;
    const Component *part = &me->system->parts[route->target_part];
    const size_t place = route->target - part->first_input;
    const Element *element = &part->inputs.variables[place];

    memmove(&me->inputs[route->target], values, route->count * sizeof *values);
    return me->parts.started[route->target_part] && !waits_for_clock(part, element->reference)
               ? part_set(me, route->target_part, (Type)part->inputs.types[place], element,
                          &me->inputs[route->target] - element->place)
               : STATUS_OK;
}

typedef struct {
    const Beginning *beginning;
    const Transfer *transfer;
} LoopOfLinks;

static Status read_all(const Beginning *b, const Transfer *transfer, double *values) {
    Status status = STATUS_OK;

    for (size_t i = 0; i < transfer->count && status <= STATUS_WARNING; i++) {
        const Route *route = &b->me->system->routes[transfer->routes[i]];
        status = read_source(b, route, values);
        values += route->count;
    }
    return status;
}

static Status evaluate(void *context, const double *x, double *y) {
    const LoopOfLinks *loop = context;
    const Route *routes = loop->beginning->me->system->routes;
    Status status = STATUS_OK;

    for (size_t i = 0; i < loop->transfer->count && status <= STATUS_WARNING; i++) {
        const Route *route = &routes[loop->transfer->routes[i]];
        status = write_target(loop->beginning, route, x);
        x += route->count;
    }
    return status > STATUS_WARNING ? status : read_all(loop->beginning, loop->transfer, y);
}

static Status solve(const Beginning *b, const Transfer *transfer) {
    Composite *me = b->me;
    LoopOfLinks context = {b, transfer};
    Status status = read_all(b, transfer, me->loop);

    if (status <= STATUS_WARNING) {
        status = loop_solve(&transfer->loop, transfer->unknowns, me->loop, evaluate, &context);
    }
    if (status > STATUS_WARNING && me->blamed == NULL) {
        me->blamed = transfer->label;
    }
    return status;
}

static Status carry(const Beginning *b, const Transfer *transfer) {
    Status status = STATUS_OK;

    for (size_t i = 0; i < transfer->count && status <= STATUS_WARNING; i++) {
        const Route *route = &b->me->system->routes[transfer->routes[i]];
        double *values = &b->me->inputs[route->target];
        status = read_source(b, route, values);
        if (status <= STATUS_WARNING) {
            status = write_target(b, route, values);
        }
    }
    return status;
}

static Status exchange_all(const Beginning *b) {
    const System *s = b->me->system;
    Status status = STATUS_OK;

    for (size_t i = 0; i < s->number_of_transfers && status <= STATUS_WARNING; i++) {
        const Transfer *transfer = &s->transfers[i];
        status = transfer->has_loop ? solve(b, transfer) : carry(b, transfer);
    }
    for (size_t i = 0; i < s->count && status <= STATUS_WARNING; i++) {
        status = begin_if_old(b, i);
    }
    return status;
}

/* Begins with this part and all that follow, and exchanges values when all have begun. */
static Status begin_from(const Beginning *b, size_t index) {
    const System *s = b->me->system;

    while (index < s->count && !s->parts[index].has_mode) {
        index++;
    }
    return index == s->count ? exchange_all(b) : begin_part(b, index, true);
}

static void forget(Composite *me) {
    for (size_t i = 0; i < me->system->count; i++) {
        const Component *part = &me->system->parts[i];
        memcpy(me->inputs + part->first_input, part->input_starts,
               part->inputs.count * sizeof(double));
    }
    memset(me->outputs, 0, me->system->outputs * sizeof(double));
    me->is_fresh = false;
    me->blamed = NULL;
    me->number_pending = 0;
}

static Status collect(Composite *me, StartValues start_values) {
    forget(me);
    me->is_collecting = true;
    const Status status = start_values.set(start_values.context);
    me->is_collecting = false;
    return status;
}

/* Begins with all parts. */
static Status begin_all(const Beginning *b) {
    Status status = start_reset_restoring(b->me);

    if (status <= STATUS_WARNING) {
        status = begin_from(b, 0);
    }
    if (status <= STATUS_WARNING) {
        *b->doing = "reading the outputs";
        status = system_refresh(b->me);
    }
    return status;
}

/* Lets some parts return to the kept start, and initializes the others with their inputs of then. */

static Status set_links(void *context) {
    const Place *place = context;
    Composite *me = place->beginning->me;
    const Component *part = &me->system->parts[place->index];
    Status status = STATUS_OK;

    for (size_t i = part->first_route; i < part->end_route && status <= STATUS_WARNING; i++) {
        const Route *route = &me->system->routes[i];
        status = write_target(place->beginning, route, &me->inputs[route->target]);
    }
    return status;
}

static Status begin_with_links(const Beginning *b, size_t index) {
    Place place = {b, index};
    const StartValues values = {.set = set_starts, .context = &place, .exchange = set_links};

    return initialize_part(b, index, values);
}

static Status begin_again(const Beginning *b) {
    Composite *me = b->me;
    Status status = start_restore(me);

    for (size_t i = 0; i < me->system->count && status <= STATUS_WARNING; i++) {
        if (!me->parts.started[i]) {
            status = begin_with_links(b, i);
        }
    }
    return status <= STATUS_WARNING ? system_refresh(me) : status;
}

static Status begin_or_return(const Beginning *b, StartValues start_values) {
    Composite *me = b->me;

    if (start_is_kept(me)) {
        const bool begun = begin_again(b) <= STATUS_WARNING;
        if (begun && start_is_the_same(me)) {
            return STATUS_OK;
        }
        if (begun) {
            start_blame(me);
        }
        me->blamed = NULL;
        const Status status = start_give_up(me);
        if (status > STATUS_WARNING || collect(me, start_values) > STATUS_WARNING) {
            return STATUS_ERROR;
        }
    }
    return begin_all(b);
}

static Status keep(const Beginning *b, StartValues start_values) {
    Composite *me = b->me;

    if (start_keep(me) <= STATUS_WARNING) {
        return STATUS_OK;
    }
    me->blamed = NULL; /* what refuses to save its state may have failed by that */
    const Status status = start_give_up(me);
    if (status > STATUS_WARNING || collect(me, start_values) > STATUS_WARNING) {
        return STATUS_ERROR;
    }
    return begin_all(b);
}

Status system_initialize(const Library *library, void *component, const Experiment *experiment,
                         StartValues start_values, const char **doing) {
    Composite *me = component;
    const Beginning beginning = {me, experiment, doing};

    (void)library;
    *doing = "setting the start values";
    Status status = collect(me, start_values);
    if (status <= STATUS_WARNING && me->system->restores &&
        !start_note(me, experiment->start_time)) {
        status = STATUS_ERROR;
    }
    if (status <= STATUS_WARNING) {
        *doing = "initialization";
        status = begin_or_return(&beginning, start_values);
    }
    return status <= STATUS_WARNING && me->system->restores ? keep(&beginning, start_values)
                                                            : status;
}
