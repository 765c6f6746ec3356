/* What the source files of a worker for a component share. */

#ifndef FMUGYM_SERVING_H
#define FMUGYM_SERVING_H

#include "channel.h"
#include "fmi.h"
#include "methods.h"

typedef struct {
    void *component; /* NULL for none */
    char *name;
} Instance;

/* Variables of one type that each step sets or gets. */
typedef struct {
    Type type;
    size_t count, size; /* of references, and of bytes */
    uint32_t *references;
} Batch;

typedef struct {
    Batch batches[NUMBER_OF_TYPES];
    size_t count;
} Batches;

/* Value references that were once asked for. Solvers tell lists apart by their place in memory. */
typedef struct List {
    struct List *next;
    size_t count;
    uint32_t references[];
} List;

/* The FMU that this process has been started for. */
typedef struct {
    Channel *channel;
    Packet in, out, message;
    Mutex sending; /* an FMU may log from threads of its own */
    const Fmi *fmi;
    Library library;
    Floats floats;
    Solving solving;
    const char *token, *resources;
    size_t number_of_structural; /* see Experiment */
    const char *structural_references, *structural_values;
    const char **categories;
    size_t number_of_categories;
    Batches inputs, outputs;
    Instance *instances;
    size_t number_of_instances;
    void **states; /* NULL for those that were freed */
    size_t number_of_states;
    List *lists;
    void *scratch;
    size_t room;
} Served;

extern Served served;

/* Ends the process. Nobody can be told, and the other side takes it as a death. */
void serving_end(int status);
/* Ends the process if there is no memory left. */
void *serving_memory(void *old, size_t size);
char *serving_copy(const char *text);
/* Begins the answer to a request with a status. */
void serving_answer(Status status);
/* Takes a size from the request. */
size_t serving_take_size(void);
/* Copies a block of the request; the caller frees it. NULL if it is empty. */
void *serving_take_copy(size_t *size);

/* Answers to requests */

void serving_open(void);
void serving_get_state(Instance *me);
void serving_set_state(Instance *me);
void serving_free_state(Instance *me);
void serving_state_size(Instance *me);
void serving_serialize(Instance *me);
void serving_deserialize(Instance *me);

#endif
