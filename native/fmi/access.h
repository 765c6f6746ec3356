/* A list of variables. One call per C type and instance gets or sets them. */

#ifndef FMUGYM_ACCESS_H
#define FMUGYM_ACCESS_H

#include "fmi/fmi.h"

/* What stands in a list of variables in the place of a type, where the value is no variable's but the
 * start time of the episode. */
enum { START_TIME = 255 };

/* A variable: a scalar, or one element of an array. */
typedef struct {
    uint32_t reference;
    uint32_t place; /* of the element in its array, in row-major order; 0 for a scalar */
    uint32_t size;  /* of the array; 1 for a scalar */
} Element;

/* Values of a list, and where they are in the memory that the FMU reads and writes. */
typedef struct {
    size_t count;
    uint32_t *positions; /* in the list */
    uint32_t *places;    /* in the FMU's memory */
} Part;

/* The variables of one C type. An array is moved as a whole, so there is one value reference for
 * all of its elements. */
typedef struct {
    Type type;
    size_t count, size; /* of the value references, and of the values */
    uint32_t *references, *offsets;
    Part listed, rest; /* rest: of arrays that are not listed as a whole, the other elements */
} Group;

typedef struct Access {
    const Fmi *fmi;
    uint64_t id; /* unique in the process */
    size_t count;
    size_t width; /* the larger of count and the most values of a group */
    size_t number_of_groups;
    bool direct;        /* all values are doubles: the FMU uses the list's own memory */
    ptrdiff_t start_time; /* position of the start time, or -1 */
    Element *variables; /* in the order of the list */
    uint8_t *types;
    double *rest;     /* the values of the elements that are not listed */
    size_t *first_texts; /* of each variable, where its texts begin; where the last ones end */
    const char **texts;  /* those that Strings may get */
    char *letters;       /* of the texts */
    uint32_t *memory; /* of all groups */
    Group groups[NUMBER_OF_TYPES];
} Access;

typedef struct {
    const char *bytes;
    size_t size;
} Block;

/* What an access is made of. The variables that follow the list are the elements that are missing
 * in it: FMI sets whole arrays only. */
typedef struct {
    const uint8_t *types;
    const char *elements; /* of type Element, not aligned */
    size_t count;         /* of the list */
    const char *rest;     /* the values of the other elements: doubles, not aligned */
    size_t number_of_rest;
    const char *counts;   /* uint32_t, not aligned: how many texts each String of the list may get */
    Block texts;          /* all of them, each with a zero at its end */
} Listing;

/* Whether a byte is a Type or START_TIME. */
static inline bool is_type(uint8_t type) {
    return type < NUMBER_OF_TYPES || type == START_TIME;
}

/* Checks blocks of bytes and takes a listing from them, which refers to them. Returns what is wrong
 * with them, or NULL. */
const char *listing_take(Listing *listing, Block types, Block elements, Block rest, Block counts,
                         Block texts);

/* Groups the variables by type, in the order in which the types first appear. The start time belongs
 * to no group. Returns whether there was enough memory. */
bool access_open(Access *access, const Fmi *fmi, const Listing *listing);
/* Whether all places are in the memory of their groups, which is of a sensible size. */
bool access_is_sound(const Access *access);
void access_close(Access *access);

/* Whether the variables are scalars of type double, each in its place. */
static inline bool access_is_plain(const Access *access) {
    return access->direct && access->groups[0].count == access->groups[0].size;
}

/* A scalar or an array as a whole. Both functions are those below for one variable. */
Status variable_get(const Fmi *fmi, const Library *library, void *component, Type type,
                    const Element *variable, double *values, void *typed, const Floats *floats);
Status variable_set(const Fmi *fmi, const Library *library, void *component, Type type,
                    const Element *variable, const double *values, void *typed,
                    const Floats *floats);

/* Both functions use typed as scratch memory for width doubles and return the worst
 * status. They stop after the first type whose status is worse than a warning. They restore the
 * floating-point environment after each call into the FMU. Both leave Strings out. */
Status access_get(const Access *access, const Library *library, void *component, double *values,
                  void *typed, const Floats *floats);
Status access_set(const Access *access, const Library *library, void *component,
                  const double *values, void *typed, const Floats *floats);

/* The text of a variable for which a value stands, its place among those that a String may get; NULL
 * if there is none. */
const char *access_text(const Access *access, size_t variable, double value);
/* Sets the Strings. Of one that is refused, sets refused to the value reference. */
Status access_set_texts(const Access *access, const Library *library, void *component,
                        const double *values, const Floats *floats, uint32_t *refused);

#endif
