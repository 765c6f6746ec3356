#include "solved.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* A component: the solver, and the values that were last set, by type. Inputs that stay the same
 * need no event. */
typedef struct {
    const uint32_t *references;
    size_t size, room;
    char *bytes;
} LastSet;

typedef struct {
    Solver solver; /* first, so that both have one address */
    LastSet last[NUMBER_OF_TYPES];
} Solved;

/* What takes the place of an FMU state. */
typedef struct {
    void *state; /* of the FMU */
    Memory memory;
} SolvedState;

static const Fmi *fmi_of(const Solver *me) {
    return me->model->fmi;
}

static bool good(Status status) {
    return status <= STATUS_WARNING;
}

static void forget_last(Solved *me) {
    for (int type = 0; type < NUMBER_OF_TYPES; type++) {
        me->last[type].references = NULL;
    }
}

static void forget(Solved *me) {
    memset(&me->solver.memory, 0, sizeof me->solver.memory);
    me->solver.memory.next_event = INFINITY;
    me->solver.stale = true;
    forget_last(me);
}

void *solved_take(const Model *model, const Library *library, const Identity *identity,
                  void *component) {
    Solved *me = component == NULL ? NULL : calloc(1, sizeof *me);

    if (me != NULL) {
        me->solver = (Solver){.model = model,
                              .equations = (const Equations *)((const char *)library->functions +
                                                               model->equations),
                              .library = library,
                              .component = component,
                              .solving = identity->solving,
                              .floats = identity->floats,
                              .environment = identity->environment};
        forget(me);
        if (solver_open(&me->solver)) {
            return me;
        }
    }
    if (component != NULL) {
        model->fmi->free_instance(library, component);
    }
    free(me);
    return NULL;
}

void solved_free(const Library *library, void *component) {
    Solved *me = component;

    fmi_of(&me->solver)->free_instance(library, me->solver.component);
    for (int type = 0; type < NUMBER_OF_TYPES; type++) {
        free(me->last[type].bytes);
    }
    solver_close(&me->solver);
    free(me);
}

Status solved_choose_messages(const Library *library, void *component,
                              const char *const *categories, size_t count) {
    const Solver *me = component;
    return fmi_of(me)->choose_messages(library, me->component, categories, count);
}

/* Afterwards the FMU is in continuous time, unless it has asked to stop: the first step then tells
 * so. */
Status solved_initialize(const Library *library, void *component, const Experiment *experiment,
                         StartValues start_values, const char **doing) {
    Solver *me = component;

    forget(component);
    me->memory.time = experiment->start_time;
    const Status status =
        fmi_of(me)->initialize(library, me->component, experiment, start_values, doing);
    if (!good(status)) {
        return status;
    }
    *doing = "the initial event";
    me->memory.mode = IN_EVENTS;
    return solver_settle(me);
}

Status solved_do_step(const Library *library, void *component, double time, double step,
                      bool no_return) {
    (void)library;
    (void)no_return;
    return solver_advance(component, time + step);
}

Status solved_get(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, void *values, size_t size) {
    const Solver *me = component;
    return fmi_of(me)->get(library, me->component, type, references, count, values, size);
}

static size_t size_of(const Fmi *fmi, Type type) {
    static const size_t sizes[NUMBER_OF_TYPES] = {8, 4, 1, 2, 4, 8, 1, 2, 4, 8, 0};
    return type == TYPE_BOOLEAN ? fmi->boolean_size : sizes[type];
}

/* Notes values; returns whether they are the same as those noted before. */
static bool is_repeated(LastSet *last, const uint32_t *references, const void *values,
                        size_t size) {
    if (last->references == references && last->size == size &&
        memcmp(last->bytes, values, size) == 0) {
        return true;
    }
    if (last->room < size) {
        free(last->bytes);
        last->bytes = malloc(size);
        last->room = last->bytes == NULL ? 0 : size;
    }
    last->references = last->room < size ? NULL : references;
    last->size = size;
    if (last->references != NULL) {
        memcpy(last->bytes, values, size);
    }
    return false;
}

/* New values of inputs and parameters are an event: they may jump. */
Status solved_set(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, const void *values, size_t size) {
    Solved *me = component;
    const Fmi *fmi = fmi_of(&me->solver);
    Status status = STATUS_OK;

    if (me->solver.memory.mode != BEFORE_EVENTS) {
        if (is_repeated(&me->last[type], references, values, size * size_of(fmi, type))) {
            return STATUS_OK;
        }
        if (me->solver.memory.mode == IN_CONTINUOUS_TIME) {
            status = solver_enter_events(&me->solver);
        }
    }
    if (good(status)) {
        status = fmi->set(library, me->solver.component, type, references, count, values, size);
    }
    if (!good(status)) {
        me->last[type].references = NULL;
    }
    return status;
}

Status solved_set_string(const Library *library, void *component, uint32_t reference,
                         const char *text) {
    const Solver *me = component;
    return fmi_of(me)->set_string(library, me->component, reference, text);
}

Status solved_reset(const Library *library, void *component) {
    const Solver *me = component;

    forget(component);
    return fmi_of(me)->reset(library, me->component);
}

Status solved_terminate(const Library *library, void *component) {
    const Solver *me = component;
    return fmi_of(me)->terminate(library, me->component);
}

/* FMU states */

/* If the FMU makes a new state instead of overwriting the old one, so does this function, and the
 * caller sees it. */
Status solved_get_state(const Library *library, void *component, void **state) {
    const Solver *me = component;
    SolvedState *old = *state, *saved = old;
    void *inner = old == NULL ? NULL : old->state;
    const Status status = fmi_of(me)->get_state(library, me->component, &inner);

    if (old == NULL || old->state != inner) {
        saved = malloc(sizeof *saved);
        free(saved == NULL ? NULL : old);
    }
    if (saved == NULL) {
        return STATUS_ERROR;
    }
    *saved = (SolvedState){inner, me->memory};
    *state = saved;
    if (!good(status) && inner == NULL) {
        free(saved);
        *state = NULL;
    }
    return status;
}

Status solved_set_state(const Library *library, void *component, void *state) {
    Solver *me = component;
    const SolvedState *saved = state;

    forget(component);
    me->memory = saved->memory;
    return fmi_of(me)->set_state(library, me->component, saved->state);
}

Status solved_free_state(const Library *library, void *component, void **state) {
    const Solver *me = component;
    SolvedState *saved = *state;
    const Status status = fmi_of(me)->free_state(library, me->component, &saved->state);

    free(saved);
    *state = NULL;
    return status;
}

size_t solved_state_size(const Library *library, void *component, void *state) {
    const Solver *me = component;
    const SolvedState *saved = state;
    const size_t size = fmi_of(me)->state_size(library, me->component, saved->state);
    return size == 0 ? 0 : size + sizeof(Memory);
}

Status solved_serialize(const Library *library, void *component, void *state, char *bytes,
                        size_t size) {
    const Solver *me = component;
    const SolvedState *saved = state;

    memcpy(bytes, &saved->memory, sizeof(Memory));
    return fmi_of(me)->serialize(library, me->component, saved->state, bytes + sizeof(Memory),
                                 size - sizeof(Memory));
}

Status solved_deserialize(const Library *library, void *component, const char *bytes, size_t size,
                          void **state) {
    const Solver *me = component;
    SolvedState *saved = size < sizeof(Memory) ? NULL : calloc(1, sizeof *saved);

    if (saved == NULL) {
        return STATUS_ERROR;
    }
    memcpy(&saved->memory, bytes, sizeof(Memory));
    const Status status =
        fmi_of(me)->deserialize(library, me->component, bytes + sizeof(Memory),
                                size - sizeof(Memory), &saved->state);
    *state = saved;
    if (!good(status)) {
        free(saved);
        *state = NULL;
    }
    return status;
}
