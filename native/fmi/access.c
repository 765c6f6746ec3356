/* Groups of variables, and the conversion between float64 and the C types of FMI. */

#include "fmi/access.h"

#include <stdlib.h>
#include <string.h>

#include "shared/floats.h"
#include "shared/platform.h"

enum { LARGEST_GROUP = 1 << 28 }; /* values */

static Atomic next_id;

/* Only what is listed may be the start time. */
static bool are_sound(const char *types, const char *elements, size_t count, size_t listed) {
    for (size_t i = 0; i < count; i++) {
        Element element;
        memcpy(&element, elements + i * sizeof element, sizeof element);
        if (!is_type((uint8_t)types[i]) || element.place >= element.size ||
            (i >= listed && (uint8_t)types[i] == START_TIME)) {
            return false;
        }
    }
    return true;
}

static size_t count_of(const char *counts, size_t string) {
    uint32_t count;
    memcpy(&count, counts + string * sizeof count, sizeof count);
    return count;
}

/* There are as many texts as the Strings of the list may get, and the last one ends. */
static bool texts_are_sound(const Listing *listing, Block counts) {
    const Block texts = listing->texts;
    uint64_t wanted = 0, found = 0;
    size_t strings = 0;

    for (size_t i = 0; i < listing->count; i++) {
        strings += listing->types[i] == TYPE_STRING;
    }
    if (counts.size != strings * sizeof(uint32_t) ||
        (texts.size > 0 && texts.bytes[texts.size - 1] != '\0')) {
        return false;
    }
    for (size_t i = 0; i < strings; i++) {
        wanted += count_of(counts.bytes, i);
    }
    for (size_t i = 0; i < texts.size; i++) {
        found += texts.bytes[i] == '\0';
    }
    return found == wanted;
}

const char *listing_take(Listing *listing, Block types, Block elements, Block rest, Block counts,
                         Block texts) {
    const size_t count = types.size, number_of_rest = rest.size / sizeof(double);

    if (elements.size != count * sizeof(Element) || rest.size % sizeof(double) != 0 ||
        number_of_rest > count) {
        return "the parts of a list of variables differ in length";
    }
    *listing = (Listing){(const uint8_t *)types.bytes, elements.bytes, count - number_of_rest,
                         rest.bytes, number_of_rest, counts.bytes, texts};
    if (!texts_are_sound(listing, counts)) {
        return "the texts of a list of variables differ in number, or do not end";
    }
    return are_sound(types.bytes, elements.bytes, count, listing->count)
               ? NULL
               : "unknown C type, or a place outside an array";
}

static Group *group_of(Access *access, Type type) {
    for (size_t i = 0; i < access->number_of_groups; i++) {
        if (access->groups[i].type == type) {
            return &access->groups[i];
        }
    }
    Group *group = &access->groups[access->number_of_groups++];
    group->type = type;
    return group;
}

static bool allocate(Access *access, const Listing *listing) {
    const size_t all = listing->count + listing->number_of_rest;

    access->variables = malloc((all + 1) * sizeof *access->variables);
    access->types = malloc(all + 1);
    access->rest = malloc((listing->number_of_rest + 1) * sizeof *access->rest);
    access->memory = malloc((4 * all + 1) * sizeof *access->memory);
    access->first_texts = malloc((listing->count + 1) * sizeof *access->first_texts);
    access->texts = malloc((listing->texts.size + 1) * sizeof *access->texts);
    access->letters = malloc(listing->texts.size + 1);
    if (access->variables == NULL || access->types == NULL || access->rest == NULL ||
        access->memory == NULL || access->first_texts == NULL || access->texts == NULL ||
        access->letters == NULL) {
        access_close(access);
        return false;
    }
    memcpy(access->variables, listing->elements, all * sizeof *access->variables);
    memcpy(access->types, listing->types, all);
    memcpy(access->rest, listing->rest, listing->number_of_rest * sizeof *access->rest);
    return true;
}

static void keep_texts(Access *access, const Listing *listing) {
    const char *letter = access->letters;
    size_t next = 0, string = 0;

    if (listing->texts.size > 0) {
        memcpy(access->letters, listing->texts.bytes, listing->texts.size);
    }
    for (size_t i = 0; i < listing->count; i++) {
        access->first_texts[i] = next;
        next += access->types[i] == TYPE_STRING ? count_of(listing->counts, string++) : 0;
    }
    access->first_texts[listing->count] = next;
    for (size_t i = 0; i < next; i++, letter += strlen(letter) + 1) {
        access->texts[i] = letter;
    }
}

/* Each group gets the memory for as many value references as it has variables. */
static void share_memory(Access *access, size_t all) {
    uint32_t *place = access->memory;

    for (size_t i = 0; i < all; i++) {
        if (access->types[i] != START_TIME) {
            group_of(access, (Type)access->types[i])->count++;
        }
    }
    for (size_t i = 0; i < access->number_of_groups; i++) {
        Group *group = &access->groups[i];
        const size_t count = group->count;
        group->references = place;
        group->offsets = place + count;
        group->listed.positions = place + 2 * count;
        group->listed.places = place + 3 * count;
        place += 4 * count;
        group->count = 0; /* add_reference counts again */
    }
}

/* The first place of a variable's values in the memory of its group. Elements of an array mostly
 * follow each other, so that the search ends at once. */
static uint32_t offset_of(Group *group, const Element *element) {
    for (size_t i = group->count; element->size > 1 && i > 0; i--) {
        if (group->references[i - 1] == element->reference) {
            return group->offsets[i - 1];
        }
    }
    const uint32_t offset = (uint32_t)group->size;
    group->references[group->count] = element->reference;
    group->offsets[group->count++] = offset;
    group->size += element->size;
    return offset;
}

static void add(Group *group, Part *part, const Element *element, size_t position) {
    part->positions[part->count] = (uint32_t)position;
    part->places[part->count++] = offset_of(group, element) + element->place;
}

static bool is_direct(const Access *access) {
    const Group *group = access->groups;
    bool direct = access->number_of_groups == 1 && group->type == TYPE_FLOAT64 &&
                  group->size == group->listed.count && group->rest.count == 0 &&
                  (access->start_time < 0 || access->start_time == (ptrdiff_t)access->count - 1);

    for (size_t i = 0; direct && i < group->listed.count; i++) {
        direct = group->listed.places[i] == i;
    }
    return direct;
}

static size_t width_of(const Access *access) {
    size_t width = access->count;

    for (size_t i = 0; i < access->number_of_groups; i++) {
        width = access->groups[i].size > width ? access->groups[i].size : width;
    }
    return width;
}

bool access_open(Access *access, const Fmi *fmi, const Listing *listing) {
    const size_t all = listing->count + listing->number_of_rest;

    memset(access, 0, sizeof *access);
    access->fmi = fmi;
    access->id = 1 + atomic_add(&next_id, 1);
    access->count = listing->count;
    access->start_time = -1;
    if (!allocate(access, listing)) {
        return false;
    }
    keep_texts(access, listing);
    share_memory(access, all);
    for (size_t i = 0; i < listing->count; i++) {
        if (access->types[i] == START_TIME) {
            access->start_time = (ptrdiff_t)i;
            continue;
        }
        Group *group = group_of(access, (Type)access->types[i]);
        add(group, &group->listed, &access->variables[i], i);
    }
    for (size_t i = listing->count; i < all; i++) {
        Group *group = group_of(access, (Type)access->types[i]);
        group->rest.positions = group->listed.positions + group->listed.count;
        group->rest.places = group->listed.places + group->listed.count;
        add(group, &group->rest, &access->variables[i], i - listing->count);
    }
    access->direct = is_direct(access);
    access->width = width_of(access);
    return true;
}

static bool are_within(const Part *part, size_t size) {
    for (size_t i = 0; i < part->count; i++) {
        if (part->places[i] >= size) {
            return false;
        }
    }
    return true;
}

bool access_is_sound(const Access *access) {
    for (size_t i = 0; i < access->number_of_groups; i++) {
        const Group *group = &access->groups[i];
        if (group->size > LARGEST_GROUP || !are_within(&group->listed, group->size) ||
            !are_within(&group->rest, group->size)) {
            return false;
        }
    }
    return true;
}

void access_close(Access *access) {
    free(access->variables);
    free(access->types);
    free(access->rest);
    free(access->memory);
    free(access->first_texts);
    free((void *)access->texts);
    free(access->letters);
    access->first_texts = NULL;
    access->texts = NULL;
    access->letters = NULL;
    access->variables = NULL;
    access->types = NULL;
    access->rest = NULL;
    access->memory = NULL;
}

/* Conversions. A float64 outside the range of an integer type becomes the nearest value of that
 * type, and NaN becomes 0. Plain casts would be undefined behaviour. */

static double clamp(double value, double low, double high) {
    if (value != value) {
        return 0.0;
    }
    return value < low ? low : value > high ? high : value;
}

static int64_t to_int64(double value) {
    if (value != value) {
        return 0;
    }
    if (value >= 9223372036854775808.0) {
        return INT64_MAX;
    }
    return value <= -9223372036854775808.0 ? INT64_MIN : (int64_t)value;
}

static uint64_t to_uint64(double value) {
    if (!(value > 0.0)) {
        return 0;
    }
    return value >= 18446744073709551616.0 ? UINT64_MAX : (uint64_t)value;
}

#define LOAD_AS(type, convert)                                                                     \
    for (size_t i = 0; i < part->count; i++) {                                                     \
        const double value = (double)((const type *)typed)[part->places[i]];                       \
        values[part->positions[i]] = (convert);                                                    \
    }                                                                                              \
    break
#define LOAD(type) LOAD_AS(type, value)

static void load(const Part *part, Type type, const void *typed, double *values) {
    switch (type) {
    case TYPE_FLOAT64: LOAD(double);
    case TYPE_FLOAT32: LOAD(float);
    case TYPE_INT8: LOAD(int8_t);
    case TYPE_INT16: LOAD(int16_t);
    case TYPE_INT32: LOAD(int32_t);
    case TYPE_INT64: LOAD(int64_t);
    case TYPE_UINT8: LOAD(uint8_t);
    case TYPE_UINT16: LOAD(uint16_t);
    case TYPE_UINT32: LOAD(uint32_t);
    case TYPE_UINT64: LOAD(uint64_t);
    case TYPE_NEGATED_FLOAT64: LOAD_AS(double, 0.0 - value); /* never -0.0 */
    case TYPE_NEGATED_INT32: LOAD_AS(int32_t, 0.0 - value);
    case TYPE_NEGATED_BOOLEAN: LOAD_AS(uint8_t, value == 0.0);
    default: break;
    }
}

#define STORE(type, convert)                                                                       \
    for (size_t i = 0; i < part->count; i++) {                                                     \
        const double value = values[part->positions[i]];                                           \
        ((type *)typed)[part->places[i]] = (type)(convert);                                        \
    }                                                                                              \
    break

static void store(const Part *part, Type type, const double *values, void *typed) {
    switch (type) {
    case TYPE_FLOAT64: STORE(double, value);
    case TYPE_FLOAT32: STORE(float, value);
    case TYPE_INT8: STORE(int8_t, clamp(value, INT8_MIN, INT8_MAX));
    case TYPE_INT16: STORE(int16_t, clamp(value, INT16_MIN, INT16_MAX));
    case TYPE_INT32: STORE(int32_t, clamp(value, INT32_MIN, INT32_MAX));
    case TYPE_INT64: STORE(int64_t, to_int64(value));
    case TYPE_UINT8: STORE(uint8_t, clamp(value, 0, UINT8_MAX));
    case TYPE_UINT16: STORE(uint16_t, clamp(value, 0, UINT16_MAX));
    case TYPE_UINT32: STORE(uint32_t, clamp(value, 0, UINT32_MAX));
    case TYPE_UINT64: STORE(uint64_t, to_uint64(value));
    case TYPE_NEGATED_FLOAT64: STORE(double, 0.0 - value);
    case TYPE_NEGATED_INT32: STORE(int32_t, clamp(0.0 - value, INT32_MIN, INT32_MAX));
    case TYPE_NEGATED_BOOLEAN: STORE(uint8_t, value == 0.0);
    default: break;
    }
}

/* A Boolean is a char in FMI 1.0, an int in FMI 2.0, a C bool in FMI 3.0. */
static Type stored_type(const Fmi *fmi, Type type) {
    const Type boolean = fmi->boolean_size == 1 ? TYPE_UINT8 : TYPE_INT32;
    if (type == TYPE_CLOCK) {
        return TYPE_UINT8;
    }
    return type == TYPE_BOOLEAN ? boolean : type;
}

Status access_get(const Access *access, const Library *library, void *component, double *values,
                  void *typed, const Floats *floats) {
    const Fmi *fmi = access->fmi;
    const Group *group = access->groups;
    Status worst = STATUS_OK;

    if (access->direct) {
        worst = fmi->get(library, component, TYPE_FLOAT64, group->references, group->count, values,
                         group->size);
        floats_restore_if_seen(floats);
        return worst;
    }
    for (size_t i = 0; i < access->number_of_groups && worst <= STATUS_WARNING; i++, group++) {
        if (group->type == TYPE_STRING) {
            continue;
        }
        const Status status = fmi->get(library, component, group->type, group->references,
                                       group->count, typed, group->size);
        worst = status > worst ? status : worst;
        floats_restore_if_seen(floats);
        load(&group->listed, stored_type(access->fmi, group->type), typed, values);
    }
    return worst;
}

Status access_set(const Access *access, const Library *library, void *component,
                  const double *values, void *typed, const Floats *floats) {
    const Fmi *fmi = access->fmi;
    const Group *group = access->groups;
    Status worst = STATUS_OK;

    if (access->direct) {
        worst = fmi->set(library, component, TYPE_FLOAT64, group->references, group->count, values,
                         group->size);
        floats_restore_if_seen(floats);
        return worst;
    }
    for (size_t i = 0; i < access->number_of_groups && worst <= STATUS_WARNING; i++, group++) {
        if (group->type == TYPE_STRING) {
            continue;
        }
        store(&group->listed, stored_type(access->fmi, group->type), values, typed);
        store(&group->rest, stored_type(access->fmi, group->type), access->rest, typed);
        const Status status = fmi->set(library, component, group->type, group->references,
                                       group->count, typed, group->size);
        worst = status > worst ? status : worst;
        floats_restore_if_seen(floats);
    }
    return worst;
}

/* One element after the other is the whole of an array. */
static void move(Type type, size_t size, double *values, void *typed, bool loads) {
    for (uint32_t i = 0; i < size; i++) {
        const Part one = {1, &i, &i};
        if (loads) {
            load(&one, type, typed, values);
        } else {
            store(&one, type, values, typed);
        }
    }
}

Status variable_get(const Fmi *fmi, const Library *library, void *component, Type type,
                    const Element *variable, double *values, void *typed, const Floats *floats) {
    const bool direct = type == TYPE_FLOAT64;
    const Status status = fmi->get(library, component, type, &variable->reference, 1,
                                   direct ? values : typed, variable->size);

    floats_restore_if_seen(floats);
    if (!direct) {
        move(stored_type(fmi, type), variable->size, values, typed, true);
    }
    return status;
}

Status variable_set(const Fmi *fmi, const Library *library, void *component, Type type,
                    const Element *variable, const double *values, void *typed,
                    const Floats *floats) {
    const bool direct = type == TYPE_FLOAT64;

    if (!direct) {
        move(stored_type(fmi, type), variable->size, (double *)values, typed, false);
    }
    const Status status = fmi->set(library, component, type, &variable->reference, 1,
                                   direct ? values : typed, variable->size);
    floats_restore_if_seen(floats);
    return status;
}

const char *access_text(const Access *access, size_t variable, double value) {
    const size_t first = access->first_texts[variable];
    const size_t count = access->first_texts[variable + 1] - first;
    return value >= 0.0 && value < (double)count ? access->texts[first + (size_t)value] : NULL;
}

Status access_set_texts(const Access *access, const Library *library, void *component,
                        const double *values, const Floats *floats, uint32_t *refused) {
    Status worst = STATUS_OK;

    for (size_t i = 0; i < access->count && worst <= STATUS_WARNING; i++) {
        if (access->types[i] != TYPE_STRING) {
            continue;
        }
        const char *text = access_text(access, i, values[i]);
        const Status status = text == NULL
                                  ? STATUS_ERROR
                                  : access->fmi->set_string(library, component,
                                                            access->variables[i].reference, text);
        worst = status > worst ? status : worst;
        floats_restore_if_seen(floats);
        *refused = status > STATUS_WARNING ? access->variables[i].reference : *refused;
    }
    return worst;
}
