/* What the source files of components in other processes share. */

#ifndef FMUGYM_FAR_H
#define FMUGYM_FAR_H

#include "host.h"
#include "system.h"

#if !defined _WIN32

/* What takes the place of a table of functions. */
typedef struct {
    const Component *part;
    size_t parts; /* of the system */
    size_t count;
    Host hosts[];
} Hosts;

static inline Hosts *hosts_of(const Library *library) {
    return library->functions;
}

/* An instance. Its lists of variables are those of the part: each step sets and gets them. */
typedef struct {
    const Component *part;
    Host *host;
    uint64_t generation; /* of the host when the instance was made */
    uint64_t number;     /* by which the worker knows it */
    Identity identity;
    size_t categories;   /* how many it was asked for last */
    bool holds;          /* whether this instance is in its initialization, and has the lock */
    bool steps;          /* whether it is initialized, so that inputs may wait for a step */
    uint32_t waiting;    /* the groups of inputs that the worker does not know yet, one bit each */
    uint32_t fresh;      /* the groups of outputs that are those of the FMU */
    uint8_t got[NUMBER_OF_TYPES]; /* the statuses of getting these */
    const char *fate;             /* why the process is gone, or NULL */
    char values[];                /* of the groups of inputs, then of the groups of outputs */
} Far;

/* Begins a request about an instance, to which arguments are put. far_end ends it, whatever becomes of
 * it. */
void far_begin(Far *me);
void far_end(Far *me);
/* Sends the request. Returns whether there is an answer to take. */
bool far_send(Far *me, char code, int patience, char *answer);
/* The same for an answer that begins with a status, which is STATUS_FATAL if there is none. */
Status far_ask(Far *me, char code);
/* Begins, sends and ends a request without arguments. */
Status far_ask_simply(Far *me, char code);
Status far_take_status(Far *me);
/* Whether its worker is still there. The caller is within a request. */
bool far_is_alive(const Far *me);

/* In bytes. */
size_t far_size_of_group(const Access *access, size_t index);
/* The places of the values of a group. */
char *far_input_values(Far *me, size_t index);
char *far_output_values(Far *me, size_t index);
/* Forgets inputs that wait, and what is known of outputs. */
void far_forget_values(Far *me);
/* Sets the inputs that wait, because a request other than a step needs them. */
Status far_set_waiting(Far *me);

/* If the worker has ended with an instance of another system, this one begins anew without being asked
 * to. Returns whether it is as good as just made. */
bool far_made_anew(Far *me);

/* Functions of the tables */

void *far_instantiate(const Library *library, const Identity *identity);
void far_free(const Library *library, void *component);
void far_drop(const Library *library, void *component);
const char *far_blamed(const void *component);
Status far_choose_messages(const Library *library, void *component, const char *const *categories,
                           size_t count);
Status far_get(const Library *library, void *component, Type type, const uint32_t *references,
               size_t count, void *values, size_t size);
Status far_set(const Library *library, void *component, Type type, const uint32_t *references,
               size_t count, const void *values, size_t size);
Status far_get_string(const Library *library, void *component, uint32_t reference,
                      const char **text);
Status far_set_string(const Library *library, void *component, uint32_t reference,
                      const char *text);
Status far_get_state(const Library *library, void *component, void **state);
Status far_set_state(const Library *library, void *component, void *state);
Status far_free_state(const Library *library, void *component, void **state);
size_t far_state_size(const Library *library, void *component, void *state);
Status far_serialize(const Library *library, void *component, void *state, char *bytes,
                     size_t size);
Status far_deserialize(const Library *library, void *component, const char *bytes, size_t size,
                       void **state);

#endif

#endif
