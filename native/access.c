/* Groups of variables, and the conversion between float64 and the C types of FMI. */

#include "access.h"

#include <stdlib.h>
#include <string.h>

#include "floats.h"
#include "platform.h"

static Atomic next_id;

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

static void assign_memory(Access *access) {
    uint32_t *place = access->memory;
    for (size_t i = 0; i < access->number_of_groups; i++) {
        Group *group = &access->groups[i];
        group->references = place;
        group->positions = place + group->count;
        place += 2 * group->count;
        group->count = 0; /* the loop below counts again */
    }
}

bool access_open(Access *access, const Fmi *fmi, const uint8_t *types, const char *references,
                 size_t count) {
    memset(access, 0, sizeof *access);
    access->fmi = fmi;
    access->id = 1 + atomic_add(&next_id, 1);
    access->count = count;
    access->start_time = -1;
    access->memory = malloc((2 * count + 1) * sizeof(uint32_t));
    if (access->memory == NULL) {
        return false;
    }
    for (size_t i = 0; i < count; i++) {
        if (types[i] == START_TIME) {
            access->start_time = (ptrdiff_t)i;
        } else {
            group_of(access, (Type)types[i])->count++;
        }
    }
    assign_memory(access);
    for (size_t i = 0; i < count; i++) {
        if (types[i] == START_TIME) {
            continue;
        }
        Group *group = group_of(access, (Type)types[i]);
        memcpy(&group->references[group->count], references + i * sizeof(uint32_t), 4);
        group->positions[group->count++] = (uint32_t)i;
    }
    access->direct = access->number_of_groups == 1 && access->groups[0].type == TYPE_FLOAT64 &&
                     (access->start_time < 0 || access->start_time == (ptrdiff_t)count - 1);
    return true;
}

void access_close(Access *access) {
    free(access->memory);
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

#define LOAD(type)                                                                                 \
    for (size_t i = 0; i < group->count; i++) {                                                    \
        values[group->positions[i]] = (double)((const type *)typed)[i];                            \
    }                                                                                              \
    break

static void load(const Group *group, Type type, const void *typed, double *values) {
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
    default: break;
    }
}

#define STORE(type, convert)                                                                       \
    for (size_t i = 0; i < group->count; i++) {                                                    \
        const double value = values[group->positions[i]];                                          \
        ((type *)typed)[i] = (type)(convert);                                                      \
    }                                                                                              \
    break

static void store(const Group *group, Type type, const double *values, void *typed) {
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
    default: break;
    }
}

/* A Boolean is a char in FMI 1.0, an int in FMI 2.0, a C bool in FMI 3.0. */
static Type stored_type(const Access *access, const Group *group) {
    const Type boolean = access->fmi->boolean_size == 1 ? TYPE_UINT8 : TYPE_INT32;
    if (group->type == TYPE_CLOCK) {
        return TYPE_UINT8;
    }
    return group->type == TYPE_BOOLEAN ? boolean : group->type;
}

Status access_get(const Access *access, const Library *library, void *component, double *values,
                  void *typed, const Floats *floats) {
    const Fmi *fmi = access->fmi;
    const Group *group = access->groups;
    Status worst = STATUS_OK;

    if (access->direct) {
        worst = fmi->get(library, component, TYPE_FLOAT64, group->references, group->count, values);
        floats_restore_if_seen(floats);
        return worst;
    }
    for (size_t i = 0; i < access->number_of_groups && worst <= STATUS_WARNING; i++, group++) {
        const Status status =
            fmi->get(library, component, group->type, group->references, group->count, typed);
        worst = status > worst ? status : worst;
        floats_restore_if_seen(floats);
        load(group, stored_type(access, group), typed, values);
    }
    return worst;
}

Status access_set(const Access *access, const Library *library, void *component,
                  const double *values, void *typed, const Floats *floats) {
    const Fmi *fmi = access->fmi;
    const Group *group = access->groups;
    Status worst = STATUS_OK;

    if (access->direct) {
        worst = fmi->set(library, component, TYPE_FLOAT64, group->references, group->count, values);
        floats_restore_if_seen(floats);
        return worst;
    }
    for (size_t i = 0; i < access->number_of_groups && worst <= STATUS_WARNING; i++, group++) {
        store(group, stored_type(access, group), values, typed);
        const Status status =
            fmi->set(library, component, group->type, group->references, group->count, typed);
        worst = status > worst ? status : worst;
        floats_restore_if_seen(floats);
    }
    return worst;
}
