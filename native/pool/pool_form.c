/* Reader of the form of a pool: its settings, and the FMU or the system. */

#include "pool/pool_form.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model_exchange/solver.h"

/* What an FMU is called, and what it gets with each instance. */
typedef struct {
    const char *model, *token, *resources;
    const char **categories;
    size_t number_of_categories, number_of_structural;
    const void *structural_references, *structural_values;
} Names;

static Names read_names(Reader *reader) {
    Names n;

    n.model = read_text(reader);
    n.token = read_text(reader);
    n.resources = read_text(reader);
    n.categories = read_texts(reader, &n.number_of_categories);
    n.structural_references = read_array(reader, sizeof(uint32_t), &n.number_of_structural);
    n.structural_values = read_values(reader, sizeof(uint64_t), n.number_of_structural,
                                      "structural parameters differ in number");
    return n;
}

/* References, one for each state; NULL if there are none. */
static const uint32_t *read_references(Reader *reader, size_t states) {
    size_t count;
    const uint32_t *references = read_array(reader, sizeof *references, &count);

    reader_require(reader, count == 0 || count == states, "the states differ in number");
    return count == 0 ? NULL : references;
}

static bool clocks_are_sound(const Solving *solving) {
    for (size_t i = 0; i < solving->number_of_clocks; i++) {
        if (solving->clocks[i].kind > CLOCK_OUTPUT) {
            return false;
        }
    }
    for (size_t i = 0; i < solving->number_of_clocked; i++) {
        const uint32_t clock = solving->clocked[i].clock;
        if (clock != NO_CLOCK && clock >= solving->number_of_clocks) {
            return false;
        }
    }
    return true;
}

static void read_solving(Reader *reader, Solving *s) {
    if (!read_flag(reader)) {
        return;
    }
    s->method = method_of(read_text(reader));
    reader_require(reader, s->method != NULL, "there is no such solver");
    s->tolerance = read_number(reader);
    reader_require(reader, s->tolerance > 0.0, "a number is out of range");
    s->max_step = read_number(reader);
    s->states = (size_t)read_integer_in(reader, 0, INT32_MAX);
    s->indicators = (size_t)read_integer_in(reader, 0, INT32_MAX);
    s->completes = read_flag(reader);
    s->state_references = read_references(reader, s->states);
    s->rate_references = read_references(reader, s->states);
    reader_require(reader, (s->state_references == NULL) == (s->rate_references == NULL),
            "the states differ in number");
    s->clocks = read_array(reader, sizeof(Clock), &s->number_of_clocks);
    s->clocked = read_array(reader, sizeof(Clocked), &s->number_of_clocked);
    reader_require(reader, reader->fault != NULL || clocks_are_sound(s), "there is no such clock");
}

/* A solver belongs to the manners in which the pool solves equations or handles events. */
static bool solving_fits(const Fmi *fmi, const Solving *solving) {
    const bool is_alone = fmi == &fmi1 || fmi == &fmi2 || fmi == &fmi3;

    return is_alone ? solving->method == NULL
                    : solving->method != NULL && (solving->method == &by_fmu) == (fmi == &events3);
}

static void check_solving(Reader *reader, const Fmi *fmi, const Solving *solving) {
    reader_require(reader, reader->fault != NULL || solving_fits(fmi, solving),
            "the solver does not fit the FMU");
}

/* Systems */

static bool all_below(const uint32_t *numbers, size_t count, size_t limit) {
    for (size_t i = 0; i < count; i++) {
        if (numbers[i] >= limit) {
            return false;
        }
    }
    return true;
}

/* Numbers below a limit. */
static const uint32_t *read_indices(Reader *reader, size_t limit, size_t *count) {
    const uint32_t *numbers = read_array(reader, sizeof *numbers, count);
    const bool fit = reader->fault == NULL && all_below(numbers, *count, limit);

    *count = reader_require(reader, fit, "the numbers of a system do not fit together") ? *count : 0;
    return numbers;
}

/* Each variable has a value. */
static const double *read_access_and_values(Reader *reader, const Fmi *fmi, Access *access) {
    read_access(reader, fmi, access);
    return read_values(reader, sizeof(double), access->count,
                       "the values of a component differ in number");
}

static void read_part_strings(Reader *reader, Component *part) {
    size_t count;
    const uint32_t *references = read_array(reader, sizeof *references, &part->number_of_strings);
    const char **texts = read_texts(reader, &count);

    part->strings = reader_room(reader, part->number_of_strings, sizeof *part->strings);
    if (reader_require(reader, count == part->number_of_strings, "the texts differ in number")) {
        for (size_t i = 0; i < count; i++) {
            part->strings[i] = (PartString){references[i], texts[i]};
        }
    }
    free((void *)texts);
}

static void read_part(Reader *reader, Component *part) {
    part->name = read_text(reader);
    part->label = read_text(reader);
    part->not_finite = read_text(reader);
    part->fmi = read_fmi(reader);
    reader_require(reader, part->fmi != &composite, "a component is no system");
    part->has_mode = read_flag(reader);
    part->reset_method = (ResetMethod)read_integer_in(reader, METHOD_RESTORE, METHOD_LIBRARY);
    part->steps = read_integer_in(reader, 1, INT64_MAX);
    const Names n = read_names(reader);
    part->model = n.model;
    part->token = n.token;
    part->resources = n.resources;
    part->categories = n.categories;
    part->number_of_categories = n.number_of_categories;
    part->number_of_structural = n.number_of_structural;
    part->structural_references = n.structural_references;
    part->structural_values = n.structural_values;
    read_solving(reader, &part->solving);
    check_solving(reader, part->fmi, &part->solving);
    part->input_starts = read_access_and_values(reader, part->fmi, &part->inputs);
    read_access(reader, part->fmi, &part->outputs);
    part->start_values = read_access_and_values(reader, part->fmi, &part->starts);
    read_part_strings(reader, part);
    reader_require(reader,
            reader->fault != NULL || (part->inputs.start_time < 0 && part->outputs.start_time < 0 &&
                                      part->starts.start_time < 0),
            "a component has no start time of its own");
}

static void count_slots(System *s) {
    for (size_t i = 0; i < s->count; i++) {
        Component *part = &s->parts[i];
        const size_t most = part->inputs.width > part->outputs.width ? part->inputs.width
                                                                     : part->outputs.width;
        const size_t scratch = most > part->starts.width ? most : part->starts.width;
        part->first_input = s->inputs;
        part->first_output = s->outputs;
        s->inputs += part->inputs.count;
        s->outputs += part->outputs.count;
        s->scratch = scratch > s->scratch ? scratch : s->scratch;
        s->restores |= part->reset_method == METHOD_RESTORE;
        s->renews |= part->reset_method >= METHOD_INSTANCE;
    }
}

static void find_clocks(Reader *reader, System *s) {
    s->clocks = reader_room(reader, s->inputs, sizeof *s->clocks);
    for (size_t i = 0; s->clocks != NULL && i < s->count; i++) {
        const Component *part = &s->parts[i];
        for (size_t j = 0; j < part->inputs.count; j++) {
            if (part->inputs.types[j] == TYPE_CLOCK) {
                s->clocks[s->number_of_clocks++] = (uint32_t)(part->first_input + j);
            }
        }
    }
}

static void read_parts(Reader *reader, System *s) {
    s->count = read_count(reader);
    s->parts = reader_room(reader, s->count, sizeof *s->parts);
    for (size_t i = 0; i < s->count && reader->fault == NULL; i++) {
        read_part(reader, &s->parts[i]);
    }
    reader_require(reader, s->count > 0, "a system has no components");
    if (reader->fault == NULL) {
        count_slots(s);
        find_clocks(reader, s);
    }
}

static Scale scale_of(double gain, double offset) {
    return (Scale){gain, offset, gain == 1.0 && offset == 0.0};
}

static uint32_t part_with(const System *s, size_t slot, bool is_input) {
    uint32_t part = 0;
    while (part + 1 < s->count &&
           slot >= (is_input ? s->parts[part + 1].first_input : s->parts[part + 1].first_output)) {
        part++;
    }
    return part;
}

/* The routes come sorted by their targets. */
static void share_out(System *s) {
    size_t next = 0;
    for (size_t i = 0; i < s->count; i++) {
        s->parts[i].first_route = next;
        while (next < s->number_of_routes && s->routes[next].target_part == i) {
            next++;
        }
        s->parts[i].end_route = next;
    }
}

/* Whether an element's array has all of its slots around this one, and as many follow as the route
 * needs. */
static bool is_sound_slot(const Access *list, size_t place, uint32_t count) {
    const Element *element = &list->variables[place];
    return element->place <= place && count > 0 && count <= element->size - element->place &&
           element->size - element->place <= list->count - place;
}

static bool is_sound_route(const System *s, const Route *route) {
    const Component *source = &s->parts[route->source_part];
    const Component *target = &s->parts[route->target_part];
    return is_sound_slot(&source->outputs, route->source - source->first_output, route->count) &&
           is_sound_slot(&target->inputs, route->target - target->first_input, route->count);
}

/* Makes the route from its source, target and count; they are below the limits. */
static bool make_route(const System *s, const uint32_t *numbers, const double *scale, Route *route) {
    const uint32_t source = numbers[0], target = numbers[1];

    if (source >= s->outputs || target >= s->inputs) {
        return false;
    }
    *route = (Route){source, target, part_with(s, source, false), part_with(s, target, true),
                     numbers[2], scale_of(scale[0], scale[1])};
    return is_sound_route(s, route);
}

static void read_routes(Reader *reader, System *s) {
    static const char fault[] = "the routes of a system do not fit together";
    const uint32_t *numbers = read_array(reader, 3 * sizeof *numbers, &s->number_of_routes);
    const double *scales =
        read_values(reader, 2 * sizeof *scales, s->number_of_routes, fault);

    s->routes = reader_room(reader, s->number_of_routes, sizeof *s->routes);
    for (size_t i = 0; i < s->number_of_routes && reader->fault == NULL; i++) {
        Route *route = &s->routes[i];
        const bool sound = make_route(s, numbers + 3 * i, scales + 2 * i, route);
        const bool follows =
            i == 0 || (uint64_t)route[-1].target + route[-1].count <= route->target;
        reader_require(reader, sound && follows, fault);
    }
    if (reader->fault == NULL) {
        share_out(s);
    }
}

/* The arrays that variables of the system are elements of. */
typedef struct {
    const uint32_t *sizes;
    const double **starts; /* of each the start values */
    size_t count;
} Arrays;

/* The caller frees the starts. */
static Arrays read_arrays(Reader *reader) {
    Arrays arrays;
    size_t values, sum = 0;

    arrays.sizes = read_array(reader, sizeof *arrays.sizes, &arrays.count);
    const double *starts = read_array(reader, sizeof *starts, &values);
    arrays.starts = reader_room(reader, arrays.count, sizeof *arrays.starts);
    for (size_t i = 0; i < arrays.count && reader->fault == NULL; i++) {
        arrays.starts[i] = starts + sum;
        sum += arrays.sizes[i];
        reader_require(reader, sum <= values, "the start values of arrays differ in number");
    }
    return arrays;
}

static bool is_sound_end(const System *s, const End *end) {
    const int64_t place = end->element.place, after = (int64_t)end->element.size - place;
    return end->part < s->count && end->type < NUMBER_OF_TYPES && after > 0 &&
           (end->starts != NULL || end->element.size == 1) && end->output < (int64_t)s->outputs &&
           (end->input < 0 || (end->input >= place && end->input + after <= (int64_t)s->inputs));
}

enum { END_PART, END_TYPE, END_REFERENCE, END_PLACE, END_INPUT, END_OUTPUT, END_ARRAY, END_NUMBERS };

static bool fit_end(const int64_t *numbers) {
    for (size_t i = END_PART; i <= END_PLACE; i++) {
        if (numbers[i] < 0 || numbers[i] > UINT32_MAX) {
            return false;
        }
    }
    for (size_t i = END_INPUT; i < END_NUMBERS; i++) {
        if (numbers[i] < -1 || numbers[i] > INT32_MAX) {
            return false;
        }
    }
    return true;
}

/* Elements of arrays have the start values of these. */
static bool make_end(const System *s, const int64_t *numbers, const double *scales,
                     const Arrays *arrays, End *end) {
    if (!fit_end(numbers) || numbers[END_TYPE] >= NUMBER_OF_TYPES ||
        numbers[END_ARRAY] >= (int64_t)arrays->count) {
        return false;
    }
    *end = (End){.part = (uint32_t)numbers[END_PART],
                 .type = (Type)numbers[END_TYPE],
                 .element = {(uint32_t)numbers[END_REFERENCE], (uint32_t)numbers[END_PLACE], 1},
                 .input = (int32_t)numbers[END_INPUT],
                 .output = (int32_t)numbers[END_OUTPUT],
                 .scale = scale_of(scales[0], scales[1]),
                 .reading = scale_of(scales[2], scales[3])};
    if (numbers[END_ARRAY] >= 0) {
        end->starts = arrays->starts[numbers[END_ARRAY]];
        end->element.size = arrays->sizes[numbers[END_ARRAY]];
    }
    return is_sound_end(s, end);
}

static bool firsts_are_sound(const System *s, size_t count) {
    for (size_t i = 0; i < s->number_of_variables; i++) {
        if (s->first_ends[i] >= s->first_ends[i + 1] || s->first_ends[i + 1] > count) {
            return false;
        }
    }
    return true;
}

static void read_ends(Reader *reader, System *s) {
    static const char fault[] = "the variables of a system do not fit together";
    size_t firsts, count;
    Arrays arrays = read_arrays(reader);

    s->first_ends = read_array(reader, sizeof *s->first_ends, &firsts);
    const int64_t *numbers = read_array(reader, END_NUMBERS * sizeof *numbers, &count);
    const double *scales = read_values(reader, 4 * sizeof *scales, count, fault);
    s->ends = reader_room(reader, count, sizeof *s->ends);
    for (size_t i = 0; i < count && reader->fault == NULL; i++) {
        const bool sound =
            make_end(s, numbers + END_NUMBERS * i, scales + 4 * i, &arrays, &s->ends[i]);
        reader_require(reader, sound, fault);
    }
    reader_require(reader, firsts > 0, fault);
    if (reader->fault == NULL) {
        s->number_of_variables = firsts - 1;
        reader_require(reader, firsts_are_sound(s, count), fault);
    }
    free((void *)arrays.starts);
}

static void read_loop(Reader *reader, LoopLimits *loop, bool *has_loop, const char **label) {
    *has_loop = read_flag(reader);
    if (*has_loop) {
        loop->iterations = read_integer_in(reader, 1, INT64_MAX);
        loop->tolerance = read_number(reader);
        *label = read_text(reader);
    }
}

/* Reads the routes of a group or transfer, counts their values, and grows the loop memory of the system
 * to fit. */
static const uint32_t *read_solved(Reader *reader, System *s, size_t *count, size_t *unknowns) {
    const uint32_t *routes = read_indices(reader, s->number_of_routes, count);

    *unknowns = 0;
    for (size_t i = 0; i < *count; i++) {
        *unknowns += s->routes[routes[i]].count;
    }
    reader_require(reader, *unknowns <= UINT16_MAX, "a loop is too large");
    const size_t wanted = loop_memory(*unknowns);
    s->memory = wanted > s->memory ? wanted : s->memory;
    return routes;
}

static void read_groups(Reader *reader, System *s) {
    s->number_of_groups = read_count(reader);
    s->groups = reader_room(reader, s->number_of_groups, sizeof *s->groups);
    for (size_t i = 0; i < s->number_of_groups && reader->fault == NULL; i++) {
        PartGroup *group = &s->groups[i];
        group->parts = read_indices(reader, s->count, &group->count);
        group->routes = read_solved(reader, s, &group->number_of_routes, &group->unknowns);
        read_loop(reader, &group->loop, &group->has_loop, &group->label);
    }
}

static void read_transfers(Reader *reader, System *s) {
    s->number_of_transfers = read_count(reader);
    s->transfers = reader_room(reader, s->number_of_transfers, sizeof *s->transfers);
    for (size_t i = 0; i < s->number_of_transfers && reader->fault == NULL; i++) {
        Transfer *transfer = &s->transfers[i];
        transfer->routes = read_solved(reader, s, &transfer->count, &transfer->unknowns);
        read_loop(reader, &transfer->loop, &transfer->has_loop, &transfer->label);
    }
}

static void read_system(Reader *reader, Opening *o) {
    System *s = o->system = reader_room(reader, 1, sizeof *o->system);

    if (s == NULL) {
        return;
    }
    s->jacobi = read_flag(reader);
    read_parts(reader, s);
    if (reader->fault != NULL) {
        return;
    }
    read_routes(reader, s);
    read_ends(reader, s);
    read_groups(reader, s);
    read_transfers(reader, s);
}

static void drop_system(System *s) {
    for (size_t i = 0; s != NULL && s->parts != NULL && i < s->count; i++) {
        Component *part = &s->parts[i];
        access_close(&part->inputs);
        access_close(&part->outputs);
        access_close(&part->starts);
        free((void *)part->categories);
        free(part->strings);
    }
    if (s != NULL) {
        free(s->parts);
        free(s->clocks);
        free(s->routes);
        free(s->ends);
        free(s->groups);
        free(s->transfers);
        free(s);
    }
}

/* Pools */

static void read_identity(Reader *reader, Settings *s) {
    const Names n = read_names(reader);

    s->model = n.model;
    s->token = n.token;
    s->resources = n.resources;
    s->categories = n.categories;
    s->number_of_categories = n.number_of_categories;
    s->experiment.number_of_structural = n.number_of_structural;
    s->experiment.structural_references = n.structural_references;
    s->experiment.structural_values = n.structural_values;
}

static void read_experiment(Reader *reader, Settings *s) {
    Experiment *e = &s->experiment;

    e->start_time = read_number(reader);
    e->has_stop_time = read_flag(reader);
    e->stop_time = read_number(reader);
    e->has_tolerance = read_flag(reader);
    e->tolerance = read_number(reader);
    s->time_step = read_number(reader);
    s->substeps = read_integer_in(reader, 1, INT64_MAX);
    s->warm_up_steps = read_integer_in(reader, 0, INT64_MAX);
    s->retries = read_integer_in(reader, 0, s->can_save ? 30 : 0);
    s->restores = read_flag(reader) && s->can_save;
    s->rebuilds = read_flag(reader);
    s->reloads = read_flag(reader);
    s->one_initialization = read_flag(reader);
    s->records = read_flag(reader);
    reader_require(reader, isfinite(s->time_step), "a number is out of range");
}

static void read_variables(Reader *reader, Opening *o, bool is_blind, Block start_outputs) {
    Settings *s = &o->settings;

    read_access(reader, s->fmi, &o->inputs);
    read_access(reader, s->fmi, &o->outputs);
    const size_t outputs = o->outputs.count;
    s->num_observed = (size_t)read_integer_in(reader, 0, (int64_t)outputs);
    const Block sampling = read_block(reader);
    s->inputs = &o->inputs;
    s->outputs = &o->outputs;
    s->sampling = sampling.size == 0 ? NULL : (const unsigned char *)sampling.bytes;
    s->start_outputs = is_blind ? start_outputs.bytes : NULL;
    reader_require(reader, sampling.size == 0 || sampling.size == outputs, "the outputs differ in number");
    reader_require(reader, start_outputs.size == (is_blind ? outputs * sizeof(double) : 0),
            "the outputs differ in number");
    for (size_t i = 0; i < sampling.size; i++) {
        reader_require(reader, s->sampling[i] <= SAMPLE_MAX, "there is no such sampling");
    }
    reader_require(reader, reader->fault != NULL || (o->inputs.start_time < 0 && o->outputs.start_time < 0),
            "the start time is no input or output");
}

/* Without paths the instances are elsewhere. */
static void check_paths(Reader *reader, Opening *o, size_t paths) {
    Settings *s = &o->settings;
    const size_t parts = o->system == NULL ? 1 : o->system->count;

    s->elsewhere = paths == 0;
    reader_require(reader, paths == 0 || paths == parts * (s->private_libraries ? s->count : 1),
            "the libraries differ in number");
}

static void settle_system(Opening *o) {
    Settings *s = &o->settings;

    s->system = o->system;
    s->renews = o->system->renews;
    s->returns = o->system->restores;
    o->system->private_libraries = s->private_libraries;
    o->system->largest_state = STATES_LIMIT / s->count;
}

static void read_opening(Reader *reader, Opening *o) {
    Settings *s = &o->settings;
    size_t paths;

    reader_require(reader, read_integer(reader) == FORM_VERSION, "it is of another version of fmugym");
    s->fmi = read_fmi(reader);
    read_identity(reader, s);
    s->paths = read_texts(reader, &paths);
    s->private_libraries = read_flag(reader);
    s->logging = read_flag(reader);
    s->can_save = read_flag(reader) && s->fmi != NULL && s->fmi->get_state != NULL;
    read_solving(reader, &s->solving);
    if (s->fmi == &composite && reader->fault == NULL) {
        read_system(reader, o);
    } else {
        check_solving(reader, s->fmi, &s->solving);
    }
    read_experiment(reader, s);
    const bool is_blind = read_flag(reader);
    const Block start_outputs = read_block(reader);
    read_variables(reader, o, is_blind, start_outputs);
    s->count = (size_t)read_integer_in(reader, 1, INT32_MAX);
    s->threads = (size_t)read_integer_in(reader, 1, INT32_MAX);
    check_paths(reader, o, paths);
    reader_require(reader, reader->at == reader->end, form_truncated);
    if (o->system != NULL && reader->fault == NULL) {
        settle_system(o);
    }
}

const char *opening_take(Opening *o, const void *form, size_t size) {
    memset(o, 0, sizeof *o);
    o->form = form_copy(form, size);
    if (o->form == NULL) {
        return form_no_memory;
    }
    Reader reader = {o->form, o->form + size, NULL};
    read_opening(&reader, o);
    return reader.fault;
}

void opening_drop(Opening *o) {
    access_close(&o->inputs);
    access_close(&o->outputs);
    drop_system(o->system);
    free((void *)o->settings.paths);
    free((void *)o->settings.categories);
    free(o->form);
    memset(o, 0, sizeof *o);
}
