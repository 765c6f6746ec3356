/* Steps of a system: exchanging values and stepping its parts by the method of the master. */

#include "system/system.h"

#include <stdlib.h>
#include <string.h>

static bool goes_on(Status status) {
    return status <= STATUS_WARNING;
}

static Status carry(Composite *me, size_t begin, size_t end) {
    Status status = STATUS_OK;

    for (size_t i = begin; i < end && goes_on(status); i++) {
        const Route *route = &me->system->routes[i];
        status = route_carry(me, route, &me->outputs[route->source], &me->inputs[route->target]);
    }
    return status;
}

static Status carry_to(Composite *me, size_t index) {
    const Component *part = &me->system->parts[index];
    return carry(me, part->first_route, part->end_route);
}

static Status advance(Composite *me, size_t index, Span span) {
    const Component *part = &me->system->parts[index];
    const double size = span.step / (double)part->steps;
    Status status = STATUS_OK;

    for (int64_t i = 0; i < part->steps && goes_on(status); i++) {
        status = part->fmi->do_step(&me->libraries[index], me->components[index],
                                    span.time + (double)i * size, size, span.no_return);
    }
    return status;
}

/* If the FMU asks to stop, the others do their step all the same. The floating-point environment is
 * restored before another FMU runs. */
Status system_step_part(Composite *me, size_t index, Span span) {
    Status status = part_set_inputs(me, index);

    if (goes_on(status)) {
        status = advance(me, index, span);
    }
    if (status == STATUS_TERMINATED) {
        me->terminated = true;
        status = STATUS_OK;
    }
    if (goes_on(status)) {
        status = part_read(me, index);
    }
    return part_judge(me, index, status);
}

/* Algebraic loops: their parts repeat the step from its beginning. */

typedef struct {
    Composite *me;
    const PartGroup *group;
    Span span;
    bool moved; /* whether the parts are no longer at the beginning */
} Repetition;

static Status save_all(const Repetition *r) {
    Composite *me = r->me;
    Status status = STATUS_OK;

    for (size_t i = 0; i < r->group->count && goes_on(status); i++) {
        const size_t part = r->group->parts[i];
        const Fmi *fmi = me->system->parts[part].fmi;
        status = fmi->get_state == NULL
                     ? STATUS_ERROR
                     : fmi->get_state(&me->libraries[part], me->components[part],
                                      &me->parts.before[part]);
        status = part_judge(me, part, status);
    }
    return status;
}

static Status restore_all(const Repetition *r) {
    Composite *me = r->me;
    Status status = STATUS_OK;

    for (size_t i = 0; i < r->group->count && goes_on(status); i++) {
        const size_t part = r->group->parts[i];
        status = part_judge(me, part, me->system->parts[part].fmi->set_state(
                                          &me->libraries[part], me->components[part],
                                          me->parts.before[part]));
    }
    return status;
}

static Status evaluate(void *context, const double *x, double *y) {
    Repetition *r = context;
    Composite *me = r->me;
    const PartGroup *group = r->group;
    Status status = r->moved ? restore_all(r) : STATUS_OK;

    r->moved = true;
    for (size_t i = 0; i < group->number_of_routes; i++) {
        const Route *route = &me->system->routes[group->routes[i]];
        memcpy(&me->inputs[route->target], x, route->count * sizeof *x);
        x += route->count;
    }
    for (size_t i = 0; i < group->count && goes_on(status); i++) {
        status = system_step_part(me, group->parts[i], r->span);
    }
    for (size_t i = 0; i < group->number_of_routes && goes_on(status); i++) {
        const Route *route = &me->system->routes[group->routes[i]];
        status = route_carry(me, route, &me->outputs[route->source], y);
        y += route->count;
    }
    return status;
}

Status system_solve(Composite *me, const PartGroup *group, Span span) {
    Repetition repetition = {me, group, span, false};
    Status status = STATUS_OK;

    repetition.span.no_return = false;
    for (size_t i = 0; i < group->count && goes_on(status); i++) {
        status = carry_to(me, group->parts[i]);
    }
    for (size_t i = 0, first = 0; i < group->number_of_routes; i++) {
        const Route *route = &me->system->routes[group->routes[i]];
        memcpy(&me->loop[first], &me->inputs[route->target], route->count * sizeof(double));
        first += route->count;
    }
    const bool was_terminated = me->terminated;
    if (goes_on(status)) {
        status = save_all(&repetition);
    }
    if (goes_on(status)) {
        status = loop_solve(&group->loop, group->unknowns, me->loop, evaluate, &repetition);
    }
    me->terminated |= was_terminated;
    if (!goes_on(status) && me->blamed == NULL) {
        me->blamed = group->label;
    }
    return status;
}

/* In a Gauss-Seidel step, the inputs are those of now; in a Jacobi step, they have been carried. */
static Status step_group(Composite *me, const PartGroup *group, Span span) {
    const bool jacobi = me->system->jacobi;
    Status status = STATUS_OK;

    if (group->has_loop && !jacobi) {
        return system_solve(me, group, span);
    }
    for (size_t i = 0; i < group->count && goes_on(status); i++) {
        status = jacobi ? STATUS_OK : carry_to(me, group->parts[i]);
        if (goes_on(status)) {
            status = system_step_part(me, group->parts[i], span);
        }
    }
    return status;
}

void system_end_ticks(Composite *me) {
    const System *s = me->system;

    for (size_t i = 0; i < s->number_of_clocks; i++) {
        me->inputs[s->clocks[i]] = 0.0;
    }
}

Status system_do_step(const Library *library, void *component, double time, double step,
                      bool no_return) {
    Composite *me = component;
    const System *s = me->system;
    const Span span = {time, step, no_return};

    (void)library;
    me->kept.stepped = true;
    me->blamed = NULL;
    me->terminated = false;
    Status status = me->is_fresh ? STATUS_OK : system_refresh(me);
    me->is_fresh = false;
    if (goes_on(status) && s->jacobi) {
        status = carry(me, 0, s->number_of_routes);
    }
    for (size_t i = 0; i < s->number_of_groups && goes_on(status); i++) {
        status = step_group(me, &s->groups[i], span);
    }
    if (goes_on(status)) {
        system_end_ticks(me);
    }
    me->is_fresh = goes_on(status);
    return goes_on(status) && me->terminated ? STATUS_TERMINATED : status;
}
