/* Steps of many systems: part by part, each in all systems before the next.
 *
 * A part of one system after that of another runs the same code of the same FMU, and one call of
 * exchange does all of these steps. Each instance of an FMU gets the same calls in the same order as
 * in system_do_step. */

#include "system/system.h"

#include <math.h>

enum { MOST = 128 };

/* Systems that step together. One that fails leaves the line. */
typedef struct {
    const Exchange *exchange;
    const System *system;
    size_t count;
    void *systems[MOST]; /* of type Composite */
    double times[MOST];
    uint32_t numbers[MOST]; /* in the exchange */
    Outcome outcomes[MOST];
} Line;

static Composite *system_at(const Line *line, size_t index) {
    return line->systems[index];
}

static bool goes_on(Status status) {
    return status <= STATUS_WARNING;
}

/* Removes the systems whose outcome is a failure. */
static void close_ranks(Line *line) {
    size_t left = 0;

    for (size_t i = 0; i < line->count; i++) {
        if (!goes_on(line->outcomes[i].status)) {
            line->exchange->outcomes[line->numbers[i]] =
                (Outcome){line->outcomes[i].status, DOING_STEP};
            continue;
        }
        line->systems[left] = line->systems[i];
        line->times[left] = line->times[i];
        line->numbers[left++] = line->numbers[i];
    }
    line->count = left;
}

/* Whether each value is in a slot of its own, so that no FMU need be asked. */
static bool has_slots(const System *s, const uint32_t *references, size_t count, bool are_inputs) {
    for (size_t i = 0; i < count; i++) {
        if (references[i] >= s->number_of_variables) {
            return false;
        }
        const uint32_t first = s->first_ends[references[i]];
        const uint32_t end = are_inputs ? s->first_ends[references[i] + 1] : first + 1;
        for (uint32_t j = first; j < end; j++) {
            if (s->ends[j].input < 0 && (are_inputs || s->ends[j].output < 0)) {
                return false;
            }
        }
    }
    return true;
}

static void take_inputs(Line *line, size_t input) {
    const Exchange *e = line->exchange;
    const System *s = line->system;
    const uint32_t reference = e->input_references[input];

    for (uint32_t j = s->first_ends[reference]; j < s->first_ends[reference + 1]; j++) {
        const End end = s->ends[j];
        for (size_t i = 0; i < line->count; i++) {
            const size_t row = e->places[line->numbers[i]] * e->number_of_inputs;
            system_at(line, i)->inputs[end.input] = scaled(end.scale, e->inputs[row + input]);
        }
    }
}

static void give_outputs(Line *line, size_t output) {
    const Exchange *e = line->exchange;
    const End end = line->system->ends[line->system->first_ends[e->output_references[output]]];

    for (size_t i = 0; i < line->count; i++) {
        const Composite *me = line->systems[i];
        const double value = end.output >= 0 ? me->outputs[end.output] : me->inputs[end.input];
        const size_t row = e->places[line->numbers[i]] * e->number_of_outputs;
        e->outputs[row + output] = scaled(end.reading, value);
    }
}

static void carry(Line *line, const Route *route) {
    bool good = true;

    for (size_t i = 0; i < line->count; i++) {
        Composite *me = line->systems[i];
        const Status status =
            route_carry(me, route, &me->outputs[route->source], &me->inputs[route->target]);
        line->outcomes[i].status = status;
        good &= goes_on(status);
    }
    if (!good) {
        close_ranks(line);
    }
}

/* Whether the FMI version can set the inputs, step and read the outputs in one call. */
static bool is_plain(const Component *part) {
    return part->steps == 1 && access_is_plain(&part->outputs) &&
           (part->inputs.count == 0 || access_is_plain(&part->inputs));
}

static size_t offset_in(const Composite *me, const void *place) {
    return (size_t)((const char *)place - (const char *)me);
}

static Status judge(Composite *me, size_t index, Status status) {
    if (status == STATUS_TERMINATED) {
        me->terminated = true;
        return STATUS_OK;
    }
    return part_judge(me, index, status);
}

static void step_plain(Line *line, size_t index) {
    const Component *part = &line->system->parts[index];
    Composite *first = line->systems[0];
    const Blocks blocks = {line->systems, offset_in(first, &first->components[index]),
                           offset_in(first, first->inputs + part->first_input),
                           offset_in(first, first->outputs + part->first_output)};
    Exchange e = *line->exchange;

    e.input_references = part->inputs.groups[0].references;
    e.output_references = part->outputs.groups[0].references;
    e.number_of_inputs = part->inputs.count;
    e.number_of_outputs = part->outputs.count;
    e.count = line->count;
    e.times = line->times;
    e.outcomes = line->outcomes;
    e.blocks = &blocks;
    if (part->fmi->exchange(&first->libraries[index], &e)) {
        return;
    }
    for (size_t i = 0; i < line->count; i++) {
        line->outcomes[i].status = judge(line->systems[i], index, line->outcomes[i].status);
    }
    close_ranks(line);
}

static Span span_of(const Line *line, size_t i) {
    return (Span){line->times[i], line->exchange->step, line->exchange->no_return};
}

static void step_part(Line *line, size_t index) {
    const Component *part = &line->system->parts[index];

    for (size_t i = part->first_route; !line->system->jacobi && i < part->end_route; i++) {
        carry(line, &line->system->routes[i]);
    }
    if (is_plain(part) && line->count > 0) {
        step_plain(line, index);
        return;
    }
    for (size_t i = 0; i < line->count; i++) {
        line->outcomes[i].status = system_step_part(line->systems[i], index, span_of(line, i));
    }
    close_ranks(line);
}

static void step_group(Line *line, const PartGroup *group) {
    if (group->has_loop && !line->system->jacobi) {
        for (size_t i = 0; i < line->count; i++) {
            line->outcomes[i].status = system_solve(line->systems[i], group, span_of(line, i));
        }
        close_ranks(line);
        return;
    }
    for (size_t i = 0; i < group->count; i++) {
        step_part(line, group->parts[i]);
    }
}

static void begin(Line *line) {
    bool good = true;

    for (size_t i = 0; i < line->count; i++) {
        Composite *me = line->systems[i];
        me->kept.stepped = true;
        me->blamed = NULL;
        me->terminated = false;
        line->outcomes[i].status = me->is_fresh ? STATUS_OK : system_refresh(me);
        me->is_fresh = false;
        good &= goes_on(line->outcomes[i].status);
    }
    if (!good) {
        close_ranks(line);
    }
}

static bool end(Line *line) {
    bool good = true;

    for (size_t i = 0; i < line->count; i++) {
        Composite *me = line->systems[i];
        const Status status = me->terminated ? STATUS_TERMINATED : STATUS_OK;
        line->exchange->outcomes[line->numbers[i]] = (Outcome){status, DOING_STEP};
        me->is_fresh = true;
        system_end_ticks(me);
        good &= !me->terminated;
    }
    return good;
}

/* Returns whether all steps are OK. */
static bool step(Line *line) {
    const System *s = line->system;
    const size_t count = line->count;

    for (size_t i = 0; i < line->exchange->number_of_inputs; i++) {
        take_inputs(line, i);
    }
    begin(line);
    for (size_t i = 0; s->jacobi && i < s->number_of_routes; i++) {
        carry(line, &s->routes[i]);
    }
    for (size_t i = 0; i < s->number_of_groups; i++) {
        step_group(line, &s->groups[i]);
    }
    for (size_t i = 0; i < line->exchange->number_of_outputs; i++) {
        give_outputs(line, i);
    }
    const bool all_went_on = line->count == count;
    return end(line) && all_went_on;
}

static void line_up(Line *line, size_t first) {
    const Exchange *e = line->exchange;

    line->count = e->count - first < MOST ? e->count - first : MOST;
    for (size_t i = 0; i < line->count; i++) {
        line->systems[i] = e->components[first + i];
        line->times[i] = e->times[first + i];
        line->numbers[i] = (uint32_t)(first + i);
    }
}

static bool exchange_together(const Exchange *e, const System *system) {
    bool good = true;
    Line line;

    line.exchange = e;
    line.system = system;
    for (size_t first = 0; first < e->count; first += MOST) {
        line_up(&line, first);
        good &= step(&line);
    }
    return good;
}

/* What the steps of one system after the other take. */
static const Fmi one_by_one = {.set = system_set, .do_step = system_do_step, .get = system_get};

bool system_exchange(const Library *library, const Exchange *e) {
    const System *s = ((const Composite *)e->components[0])->system;
    const bool fits = has_slots(s, e->input_references, e->number_of_inputs, true) &&
                      has_slots(s, e->output_references, e->number_of_outputs, false);

    return fits ? exchange_together(e, s) : exchange_by(&one_by_one, library, e);
}
