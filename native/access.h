/* A list of variables. One call per C type and instance gets or sets them. */

#ifndef FMUGYM_ACCESS_H
#define FMUGYM_ACCESS_H

#include "fmi.h"

/* What stands in a list of variables in the place of a type, where the value is no variable's but the
 * start time of the episode. */
enum { START_TIME = 255 };

typedef struct {
    Type type;
    size_t count;
    uint32_t *references;
    uint32_t *positions; /* positions of the values in the list */
} Group;

typedef struct {
    const Fmi *fmi;
    uint64_t id; /* unique in the process */
    size_t count;
    size_t number_of_groups;
    bool direct;      /* all values are doubles: the FMU uses the list's own memory */
    ptrdiff_t start_time; /* position of the start time, or -1 */
    uint32_t *memory; /* references and positions of all groups */
    Group groups[NUMBER_OF_TYPES];
} Access;

/* Whether a byte is a Type or START_TIME. */
static inline bool is_type(uint8_t type) {
    return type < NUMBER_OF_TYPES || type == START_TIME;
}

/* Groups the variables by type, in the order in which the types first appear. The start time belongs
 * to no group. The references are 32-bit numbers and need not be aligned. Returns whether there was
 * enough memory. */
bool access_open(Access *access, const Fmi *fmi, const uint8_t *types, const char *references,
                 size_t count);
void access_close(Access *access);

/* Both functions use typed as scratch memory of access_scratch bytes and return the worst
 * status. They stop after the first type whose status is worse than a warning. They restore the
 * floating-point environment after each call into the FMU. */
static inline size_t access_scratch(const Access *access) {
    return access->count * sizeof(double);
}
Status access_get(const Access *access, const Library *library, void *component, double *values,
                  void *typed, const Floats *floats);
Status access_set(const Access *access, const Library *library, void *component,
                  const double *values, void *typed, const Floats *floats);

#endif
