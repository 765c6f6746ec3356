/* Takes the description of a system that fmugym/pool/systems.py makes. The bytes and texts in it
 * stay where they are: the arguments of the pool keep them alive. */

#include <stdlib.h>
#include <string.h>

#include "python.h"

/* Bytes that hold values of one size. */
typedef struct {
    const char *data;
    Py_ssize_t size;
} Bytes;

static size_t count_of(Bytes bytes, size_t size) {
    return (size_t)bytes.size / size;
}

static const uint32_t *numbers_of(Bytes bytes) {
    return (const uint32_t *)(const void *)bytes.data;
}

static const double *doubles_of(Bytes bytes) {
    return (const double *)(const void *)bytes.data;
}

static bool refuse(const char *what) {
    if (!PyErr_Occurred()) {
        PyErr_Format(PyExc_ValueError, "the system's %s do not fit together", what);
    }
    return false;
}

static bool all_below(Bytes numbers, size_t limit) {
    for (size_t i = 0; i < count_of(numbers, sizeof(uint32_t)); i++) {
        if (numbers_of(numbers)[i] >= limit) {
            return false;
        }
    }
    return true;
}

/* Allocates an array for the items of a tuple, and at least for one. */
static void *array_for(PyObject *tuple, size_t size, size_t *count) {
    *count = PyTuple_Check(tuple) ? (size_t)PyTuple_Size(tuple) : 0;
    void *array = PyTuple_Check(tuple) ? calloc(*count + 1, size) : NULL;

    if (array == NULL && !PyTuple_Check(tuple)) {
        PyErr_SetString(PyExc_TypeError, "a part of a system must be a tuple");
    } else if (array == NULL) {
        PyErr_NoMemory();
    }
    return array;
}

/* Parts */

/* What listing_take takes. */
typedef struct {
    Bytes types, elements, rest, texts;
} Variables;

#define BYTES(bytes) &(bytes).data, &(bytes).size
#define VARIABLES(variables)                                                                       \
    BYTES((variables).types), BYTES((variables).elements), BYTES((variables).rest),                \
        BYTES((variables).texts)

static Block block_of(Bytes bytes) {
    return (Block){bytes.data, (size_t)bytes.size};
}

/* Each variable has a value. */
static bool open_access(Access *access, const Component *part, Variables v, Bytes values) {
    Listing listing;
    const char *fault = listing_take(&listing, block_of(v.types), block_of(v.elements),
                                     block_of(v.rest), block_of(v.texts));

    if (fault != NULL || (values.data != NULL && count_of(values, 8) != listing.count)) {
        return refuse("variables");
    }
    if (!access_open(access, part->fmi, &listing)) {
        PyErr_NoMemory();
        return false;
    }
    return access->start_time < 0 || refuse("variables");
}

static bool take_part_strings(PyObject *tuple, Component *part) {
    part->strings = array_for(tuple, sizeof *part->strings, &part->number_of_strings);
    for (size_t i = 0; part->strings != NULL && i < part->number_of_strings; i++) {
        PyObject *pair = PyTuple_GetItem(tuple, (Py_ssize_t)i);
        if (!PyTuple_Check(pair) || !PyArg_ParseTuple(pair, "Iy", &part->strings[i].reference,
                                                      &part->strings[i].text)) {
            return refuse("strings");
        }
    }
    return part->strings != NULL;
}

static bool take_part(PyObject *tuple, Component *part) {
    PyObject *categories, *solving, *strings;
    Variables inputs, outputs, starts;
    Bytes input_starts, start_values, structural_references, structural_values, none = {NULL, 0};
    int version, manner, has_mode, rung;
    long long steps;

    if (!PyTuple_Check(tuple) ||
        !PyArg_ParseTuple(
            tuple, "(yyy)(iipi)(yyy)O!LO(y#y#y#y#)y#(y#y#y#y#)(y#y#y#y#)y#O!(y#y#)", &part->name,
            &part->label, &part->not_finite, &version, &manner, &has_mode, &rung, &part->model,
            &part->token, &part->resources, &PyTuple_Type, &categories, &steps, &solving,
            VARIABLES(inputs),
            BYTES(input_starts), VARIABLES(outputs), VARIABLES(starts), BYTES(start_values),
            &PyTuple_Type, &strings, BYTES(structural_references),
            BYTES(structural_values))) {
        return refuse("parts");
    }
    part->fmi = version == 0 ? NULL : fmi_of(version, manner);
    const size_t structural = count_of(structural_references, sizeof(uint32_t));
    if (part->fmi == NULL || steps < 1 || rung < RUNG_RESTORE || rung > RUNG_LIBRARY ||
        count_of(structural_values, sizeof(uint64_t)) != structural) {
        return refuse("parts");
    }
    part->number_of_structural = structural;
    part->structural_references = structural_references.data;
    part->structural_values = structural_values.data;
    part->has_mode = has_mode;
    part->rung = (Rung)rung;
    part->steps = steps;
    part->input_starts = doubles_of(input_starts);
    part->start_values = doubles_of(start_values);
    part->number_of_categories = (size_t)PyTuple_Size(categories);
    part->categories = take_texts(categories);
    return part->categories != NULL && take_solving(solving, &part->solving) &&
           open_access(&part->inputs, part, inputs, input_starts) &&
           open_access(&part->outputs, part, outputs, none) &&
           open_access(&part->starts, part, starts, start_values) &&
           take_part_strings(strings, part);
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
        s->restores |= part->rung == RUNG_RESTORE;
        s->renews |= part->rung >= RUNG_INSTANCE;
    }
}

static bool find_clocks(System *s) {
    s->clocks = calloc(s->inputs + 1, sizeof *s->clocks);
    for (size_t i = 0; s->clocks != NULL && i < s->count; i++) {
        const Component *part = &s->parts[i];
        for (size_t j = 0; j < part->inputs.count; j++) {
            if (part->inputs.types[j] == TYPE_CLOCK) {
                s->clocks[s->number_of_clocks++] = (uint32_t)(part->first_input + j);
            }
        }
    }
    return s->clocks != NULL || PyErr_NoMemory() != NULL;
}

static bool take_parts(PyObject *tuple, System *s) {
    s->parts = array_for(tuple, sizeof *s->parts, &s->count);
    for (size_t i = 0; s->parts != NULL && i < s->count; i++) {
        if (!take_part(PyTuple_GetItem(tuple, (Py_ssize_t)i), &s->parts[i])) {
            return false;
        }
    }
    if (s->parts == NULL) {
        return false;
    }
    count_slots(s);
    return find_clocks(s);
}

/* Routes and ends */

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

static bool take_routes(PyObject *tuple, System *s) {
    Bytes sources, targets, counts, gains, offsets;

    if (!PyTuple_Check(tuple) ||
        !PyArg_ParseTuple(tuple, "y#y#y#y#y#", BYTES(sources), BYTES(targets), BYTES(counts),
                          BYTES(gains), BYTES(offsets))) {
        return refuse("routes");
    }
    s->number_of_routes = count_of(sources, sizeof(uint32_t));
    s->routes = calloc(s->number_of_routes + 1, sizeof *s->routes);
    if (s->routes == NULL || targets.size != sources.size || counts.size != sources.size ||
        gains.size != 2 * sources.size || offsets.size != gains.size ||
        !all_below(sources, s->outputs) || !all_below(targets, s->inputs)) {
        return refuse("routes");
    }
    for (size_t i = 0; i < s->number_of_routes; i++) {
        const uint32_t source = numbers_of(sources)[i], target = numbers_of(targets)[i];
        s->routes[i] = (Route){source, target, part_with(s, source, false),
                               part_with(s, target, true), numbers_of(counts)[i],
                               scale_of(doubles_of(gains)[i], doubles_of(offsets)[i])};
        const Route *route = &s->routes[i], *before = i > 0 ? route - 1 : NULL;
        if (!is_sound_route(s, route) ||
            (before != NULL && target < before->target + before->count)) {
            return refuse("routes");
        }
    }
    share_out(s);
    return true;
}

static bool is_sound_end(const System *s, const End *end) {
    const int64_t place = end->element.place, after = end->element.size - place;
    return end->part < s->count && end->type < NUMBER_OF_TYPES && after > 0 &&
           (end->starts != NULL || end->element.size == 1) && end->output < (int64_t)s->outputs &&
           (end->input < 0 || (end->input >= place && end->input + after <= (int64_t)s->inputs));
}

/* Where the start values of each array begin; NULL if the sizes and the values do not fit. */
static const double **starts_of(Bytes sizes, Bytes starts) {
    const size_t count = count_of(sizes, sizeof(uint32_t));
    const double **found = calloc(count + 1, sizeof *found);
    size_t sum = 0;

    for (size_t i = 0; found != NULL && i < count; i++) {
        found[i] = doubles_of(starts) + sum;
        sum += numbers_of(sizes)[i];
    }
    if (found != NULL && sum != count_of(starts, sizeof(double))) {
        free((void *)found);
        found = NULL;
    }
    return found;
}

/* An end of which the part, type, element, slots and scale are known. Elements of arrays have the
 * start values of these. */
static void give_starts(End *end, int32_t array, Bytes sizes, const double *const *starts) {
    if (array >= 0 && (size_t)array < count_of(sizes, sizeof(uint32_t))) {
        end->starts = starts[array];
        end->element.size = numbers_of(sizes)[array];
    }
}

static bool take_ends(PyObject *tuple, System *s) {
    Bytes sizes, starts, firsts, parts, types, references, inputs, outputs, arrays, places;
    Bytes gains, offsets, reading_gains, reading_offsets;

    if (!PyTuple_Check(tuple) ||
        !PyArg_ParseTuple(tuple, "y#y#y#y#y#y#y#y#y#y#y#y#y#y#", BYTES(sizes), BYTES(starts),
                          BYTES(firsts), BYTES(parts), BYTES(types), BYTES(references),
                          BYTES(inputs), BYTES(outputs), BYTES(arrays), BYTES(places),
                          BYTES(gains), BYTES(offsets), BYTES(reading_gains),
                          BYTES(reading_offsets))) {
        return refuse("variables");
    }
    const size_t count = (size_t)types.size;
    s->number_of_variables = count_of(firsts, sizeof(uint32_t)) - 1;
    s->first_ends = numbers_of(firsts);
    s->ends = calloc(count + 1, sizeof *s->ends);
    const double **starts_of_arrays = starts_of(sizes, starts);
    bool sound = s->ends != NULL && starts_of_arrays != NULL &&
                 firsts.size >= (Py_ssize_t)sizeof(uint32_t) &&
                 count_of(parts, 4) == count && count_of(references, 4) == count &&
                 count_of(inputs, 4) == count && count_of(outputs, 4) == count &&
                 count_of(arrays, 4) == count && count_of(places, 4) == count &&
                 count_of(gains, 8) == count && count_of(offsets, 8) == count &&
                 count_of(reading_gains, 8) == count && count_of(reading_offsets, 8) == count;
    for (size_t i = 0; sound && i < count; i++) {
        s->ends[i] = (End){.part = numbers_of(parts)[i],
                           .type = (Type)(uint8_t)types.data[i],
                           .element = {numbers_of(references)[i], numbers_of(places)[i], 1},
                           .input = (int32_t)numbers_of(inputs)[i],
                           .output = (int32_t)numbers_of(outputs)[i],
                           .scale = scale_of(doubles_of(gains)[i], doubles_of(offsets)[i]),
                           .reading = scale_of(doubles_of(reading_gains)[i],
                                               doubles_of(reading_offsets)[i])};
        give_starts(&s->ends[i], (int32_t)numbers_of(arrays)[i], sizes, starts_of_arrays);
        sound = is_sound_end(s, &s->ends[i]);
    }
    for (size_t i = 0; sound && i < s->number_of_variables; i++) {
        sound = s->first_ends[i] < s->first_ends[i + 1] && s->first_ends[i + 1] <= count;
    }
    free((void *)starts_of_arrays);
    return sound || refuse("variables");
}

/* Groups and transfers */

static bool take_loop(PyObject *object, LoopMethod *loop, bool *has_loop, const char **label) {
    int newton;
    long long iterations;

    *has_loop = object != Py_None;
    if (!*has_loop) {
        return true;
    }
    if (!PyTuple_Check(object) ||
        !PyArg_ParseTuple(object, "pdLy", &newton, &loop->tolerance, &iterations, label) ||
        iterations < 1) {
        return refuse("loops");
    }
    loop->newton = newton;
    loop->iterations = iterations;
    return true;
}

static void need_memory(System *s, size_t unknowns) {
    const size_t wanted = loop_memory(unknowns);
    s->memory = wanted > s->memory ? wanted : s->memory;
}

/* How many values routes carry. */
static size_t unknowns_of(const System *s, Bytes routes) {
    size_t sum = 0;
    for (size_t i = 0; i < count_of(routes, sizeof(uint32_t)); i++) {
        sum += s->routes[numbers_of(routes)[i]].count;
    }
    return sum;
}

static bool take_group(PyObject *tuple, System *s, PartGroup *group) {
    Bytes parts, routes;
    PyObject *loop;

    if (!PyTuple_Check(tuple) || !PyArg_ParseTuple(tuple, "y#y#O", &parts.data, &parts.size,
                                                   &routes.data, &routes.size, &loop) ||
        !all_below(parts, s->count) || !all_below(routes, s->number_of_routes)) {
        return refuse("groups");
    }
    group->parts = numbers_of(parts);
    group->count = count_of(parts, sizeof(uint32_t));
    group->routes = numbers_of(routes);
    group->number_of_routes = count_of(routes, sizeof(uint32_t));
    group->unknowns = unknowns_of(s, routes);
    need_memory(s, group->unknowns);
    return take_loop(loop, &group->loop, &group->has_loop, &group->label);
}

static bool take_transfer(PyObject *tuple, System *s, Transfer *transfer) {
    Bytes routes;
    PyObject *loop;

    if (!PyTuple_Check(tuple) ||
        !PyArg_ParseTuple(tuple, "y#O", &routes.data, &routes.size, &loop) ||
        !all_below(routes, s->number_of_routes)) {
        return refuse("transfers");
    }
    transfer->routes = numbers_of(routes);
    transfer->count = count_of(routes, sizeof(uint32_t));
    transfer->unknowns = unknowns_of(s, routes);
    need_memory(s, transfer->unknowns);
    return take_loop(loop, &transfer->loop, &transfer->has_loop, &transfer->label);
}

static bool take_groups(PyObject *tuple, System *s) {
    s->groups = array_for(tuple, sizeof *s->groups, &s->number_of_groups);
    for (size_t i = 0; s->groups != NULL && i < s->number_of_groups; i++) {
        if (!take_group(PyTuple_GetItem(tuple, (Py_ssize_t)i), s, &s->groups[i])) {
            return false;
        }
    }
    return s->groups != NULL;
}

static bool take_transfers(PyObject *tuple, System *s) {
    s->transfers = array_for(tuple, sizeof *s->transfers, &s->number_of_transfers);
    for (size_t i = 0; s->transfers != NULL && i < s->number_of_transfers; i++) {
        if (!take_transfer(PyTuple_GetItem(tuple, (Py_ssize_t)i), s, &s->transfers[i])) {
            return false;
        }
    }
    return s->transfers != NULL;
}

bool take_system(PyObject *object, System **system) {
    PyObject *parts, *routes, *ends, *groups, *transfers;
    int jacobi;

    if (object == Py_None) {
        return true;
    }
    System *s = *system = calloc(1, sizeof *s);
    if (s == NULL) {
        PyErr_NoMemory();
        return false;
    }
    if (!PyTuple_Check(object) || !PyArg_ParseTuple(object, "OOOOOp", &parts, &routes, &ends,
                                                    &groups, &transfers, &jacobi)) {
        return refuse("groups");
    }
    s->jacobi = jacobi;
    return take_parts(parts, s) && take_routes(routes, s) && take_ends(ends, s) &&
           take_groups(groups, s) && take_transfers(transfers, s);
}

void drop_system(System *s) {
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
