/* The functions that FMI versions have in common, and the calls of them. For the source files of
 * the versions: their tables of functions begin with Common, or with Older. */

#ifndef FMUGYM_COMMON_H
#define FMUGYM_COMMON_H

#include "fmi/fmi.h"

/* The functions for FMU states are NULL in FMI 1.0. */
typedef struct {
    void (*free_instance)(void *component);
    int (*terminate)(void *component);
    int (*reset)(void *component);
    int (*get_state)(void *component, void **state);
    int (*set_state)(void *component, void *state);
    int (*free_state)(void *component, void **state);
    int (*state_size)(void *component, void *state, size_t *size);
    int (*serialize)(void *component, void *state, char *bytes, size_t size);
    int (*deserialize)(void *component, const char *bytes, size_t size, void **state);
} Common;

typedef int Get(void *component, const uint32_t *references, size_t count, void *values);
typedef int Set(void *component, const uint32_t *references, size_t count, const void *values);

/* FMI 1.0 and 2.0. In FMI 3.0 the functions for values have one argument more. */
typedef struct {
    Common common;
    Get *get[NUMBER_OF_TYPES];
    Set *set[NUMBER_OF_TYPES];
    int (*set_string)(void *component, const uint32_t *references, size_t count,
                      const char *const *values);
} Older;

#define COUNT_OF(array) (sizeof(array) / sizeof *(array))

/* A binding of an element of an array of functions. */
#define ELEMENT(name, table, array, type)                                                          \
    { name, offsetof(table, array) + (type) * sizeof(Function), false }

/* Those of the values of FMI 1.0. The same functions get and set the values behind negated aliases,
 * which access.c negates. */
#define BINDINGS_OF_VALUES_1                                                                       \
    ELEMENT("GetReal", Functions, older.get, TYPE_FLOAT64),                                        \
    ELEMENT("GetInteger", Functions, older.get, TYPE_INT32),                                       \
    ELEMENT("GetBoolean", Functions, older.get, TYPE_BOOLEAN),                                     \
    ELEMENT("SetReal", Functions, older.set, TYPE_FLOAT64),                                        \
    ELEMENT("SetInteger", Functions, older.set, TYPE_INT32),                                       \
    ELEMENT("SetBoolean", Functions, older.set, TYPE_BOOLEAN),                                     \
    ELEMENT("GetReal", Functions, older.get, TYPE_NEGATED_FLOAT64),                                \
    ELEMENT("GetInteger", Functions, older.get, TYPE_NEGATED_INT32),                               \
    ELEMENT("GetBoolean", Functions, older.get, TYPE_NEGATED_BOOLEAN),                             \
    ELEMENT("SetReal", Functions, older.set, TYPE_NEGATED_FLOAT64),                                \
    ELEMENT("SetInteger", Functions, older.set, TYPE_NEGATED_INT32),                               \
    ELEMENT("SetBoolean", Functions, older.set, TYPE_NEGATED_BOOLEAN)

static inline const Common *common_of(const Library *library) {
    return library->functions;
}

static inline Status reset(const Library *library, void *component) {
    const Common *f = common_of(library);
    return f->reset == NULL ? STATUS_ERROR : sane(f->reset(component));
}

static inline Status terminate(const Library *library, void *component) {
    const Common *f = common_of(library);
    return f->terminate == NULL ? STATUS_OK : sane(f->terminate(component));
}

static inline void free_instance(const Library *library, void *component) {
    common_of(library)->free_instance(component);
}

static inline Status get_state(const Library *library, void *component, void **state) {
    const Common *f = common_of(library);
    return f->get_state == NULL ? STATUS_ERROR : sane(f->get_state(component, state));
}

static inline Status set_state(const Library *library, void *component, void *state) {
    const Common *f = common_of(library);
    return f->set_state == NULL ? STATUS_ERROR : sane(f->set_state(component, state));
}

static inline Status free_state(const Library *library, void *component, void **state) {
    const Common *f = common_of(library);
    return f->free_state == NULL ? STATUS_OK : sane(f->free_state(component, state));
}

static inline size_t state_size(const Library *library, void *component, void *state) {
    const Common *f = common_of(library);
    size_t size = 0;
    if (f->state_size == NULL) {
        return 0;
    }
    return sane(f->state_size(component, state, &size)) <= STATUS_WARNING ? size : 0;
}

static inline Status serialize(const Library *library, void *component, void *state, char *bytes,
                               size_t size) {
    const Common *f = common_of(library);
    return f->serialize == NULL ? STATUS_ERROR
                                : sane(f->serialize(component, state, bytes, size));
}

static inline Status deserialize(const Library *library, void *component, const char *bytes,
                                 size_t size, void **state) {
    const Common *f = common_of(library);
    return f->deserialize == NULL ? STATUS_ERROR
                                  : sane(f->deserialize(component, bytes, size, state));
}

static inline const Older *older_of(const Library *library) {
    return library->functions;
}

static inline Status older_get(const Library *library, void *component, Type type,
                               const uint32_t *references, size_t count, void *values,
                               size_t size) {
    (void)size;
    Get *function = older_of(library)->get[type];
    return function == NULL ? STATUS_ERROR : sane(function(component, references, count, values));
}

static inline Status older_set(const Library *library, void *component, Type type,
                               const uint32_t *references, size_t count, const void *values,
                               size_t size) {
    (void)size;
    Set *function = older_of(library)->set[type];
    return function == NULL ? STATUS_ERROR : sane(function(component, references, count, values));
}

static inline Status older_set_string(const Library *library, void *component,
                                      uint32_t reference, const char *text) {
    const Older *f = older_of(library);
    return f->set_string == NULL ? STATUS_ERROR
                                 : sane(f->set_string(component, &reference, 1, &text));
}

/* The entries of these functions in a table, and of those for FMU states. */
#define SHARED_FUNCTIONS .reset = reset, .terminate = terminate, .free_instance = free_instance
#define SHARED_STATES                                                                              \
    .get_state = get_state, .set_state = set_state, .free_state = free_state,                      \
    .state_size = state_size, .serialize = serialize, .deserialize = deserialize

#endif
