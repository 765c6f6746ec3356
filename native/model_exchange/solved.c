/* An FMU of model exchange and its solver, behind the functions of co-simulation. */

#include "model_exchange/solved.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* A component: the solver, and the values that were last set, by type. Inputs that stay the same
 * need no event. */
typedef struct {
    const uint32_t *references;
    size_t count, size, room; /* the sizes in bytes */
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
    Ticks ticks[];
} SolvedState;

static const Fmi *fmi_of(const Solver *me) {
    return me->model->fmi;
}

static void forget_last(Solved *me) {
    for (int type = 0; type < NUMBER_OF_TYPES; type++) {
        me->last[type].references = NULL;
    }
}

static void forget(Solved *me) {
    memset(&me->solver.memory, 0, sizeof me->solver.memory);
    memset(me->solver.ticks, 0, solver_size_of_ticks(&me->solver));
    me->solver.memory.next_event = INFINITY;
    me->solver.stale = true;
    forget_last(me);
}

/* The parts of the library's table of functions that are the same for several versions. */
static const void *functions_at(const Library *library, size_t offset) {
    return offset == 0 ? NULL : (const char *)library->functions + offset;
}

static Status set_clocked(Solver *me, size_t clock);

void *solved_take(const Model *model, const Library *library, const Identity *identity,
                  void *component) {
    Solved *me = component == NULL ? NULL : calloc(1, sizeof *me);

    if (me != NULL) {
        me->solver = (Solver){.model = model,
                              .equations = functions_at(library, model->equations),
                              .clock_functions = functions_at(library, model->clocks),
                              .set_clocked = set_clocked,
                              .library = library,
                              .component = component,
                              .solving = identity->solving,
                              .floats = identity->floats,
                              .environment = identity->environment};
        if (solver_open(&me->solver)) {
            forget(me);
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

static Status prepare(void *solver) {
    return clocks_prepare(solver);
}

static Status initialize(Solver *me, const Experiment *experiment, StartValues start_values,
                         const char **doing) {
    Events events = {0};

    if (me->model->initialize == NULL) {
        return fmi_of(me)->initialize(me->library, me->component, experiment, start_values, doing);
    }
    const Status status = me->model->initialize(me->library, me->component, experiment,
                                                start_values, doing, &events);
    me->memory.terminated = events.terminate;
    me->memory.next_event = events.has_next ? events.next : INFINITY;
    return status;
}

/* Afterwards the FMU is in continuous time, unless it has asked to stop: the first step then tells
 * so. */
Status solved_initialize(const Library *library, void *component, const Experiment *experiment,
                         StartValues start_values, const char **doing) {
    Solver *me = component;

    (void)library;
    forget(component);
    me->memory.time = experiment->start_time;
    if (me->solving->number_of_clocks > 0) {
        start_values.prepare = prepare;
        start_values.prepared = me;
    }
    const Status status = initialize(me, experiment, start_values, doing);
    if (!good(status)) {
        return status;
    }
    *doing = "the initial event";
    me->memory.mode = IN_EVENTS;
    return solver_settle(me);
}

Status solved_do_step(const Library *library, void *component, double time, double step,
                      bool no_return) {
    Solver *me = component;

    (void)library;
    (void)no_return;
    if (me->model->step != NULL) {
        me->memory.time = time; /* which may differ from the end of the last step by its rounding */
    }
    clocks_begin_step(me);
    return solver_advance(me, time + step);
}

Status solved_get(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, void *values, size_t size) {
    const Solver *me = component;

    if (type == TYPE_CLOCK) {
        clocks_tell(me, references, count, values);
        return STATUS_OK;
    }
    return fmi_of(me)->get(library, me->component, type, references, count, values, size);
}

/* Notes values; returns whether they are the same as those noted before. */
static bool is_repeated(LastSet *last, const uint32_t *references, size_t count,
                        const void *values, size_t size) {
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
    last->count = count;
    if (last->references != NULL) {
        memcpy(last->bytes, values, size);
    }
    return false;
}

/* How many values a reference stands for. */
static size_t width_of(const Solving *s, uint32_t reference) {
    for (size_t i = 0; i < s->number_of_clocked; i++) {
        if (s->clocked[i].reference == reference) {
            return s->clocked[i].size;
        }
    }
    return 1;
}

static bool is_due(const Solver *me, uint32_t reference, size_t clock) {
    const Solving *s = me->solving;
    bool due = clock == SIZE_MAX && !clocks_own(me, reference);

    for (size_t i = 0; i < s->number_of_clocked; i++) {
        due |= s->clocked[i].clock == clock && s->clocked[i].reference == reference;
    }
    return due;
}

/* Sets some of the values that were last set: those of inputs with this clock, or, if there is no
 * such clock, those of inputs without clocks. */
static Status set_one_by_one(Solved *me, Type type, size_t clock) {
    const Solver *solver = &me->solver;
    const LastSet *last = &me->last[type];
    const size_t size = value_size(fmi_of(solver), type);
    const size_t count = last->references == NULL ? 0 : last->count;
    size_t place = 0;
    Status status = STATUS_OK;

    for (size_t i = 0; i < count && good(status); i++) {
        const size_t width = width_of(solver->solving, last->references[i]);
        if ((place + width) * size > last->size) {
            return STATUS_ERROR;
        }
        if (is_due(solver, last->references[i], clock)) {
            status = fmi_of(solver)->set(solver->library, solver->component, type,
                                         &last->references[i], 1, last->bytes + place * size,
                                         width);
            floats_restore_if_seen(solver->floats);
        }
        place += width;
    }
    return status;
}

static Status set_clocked(Solver *solver, size_t clock) {
    Status status = STATUS_OK;

    for (int type = 0; type < TYPE_CLOCK && good(status); type++) {
        status = set_one_by_one((Solved *)solver, (Type)type, clock);
    }
    return status;
}

static Status set_clocks(Solver *me, const uint32_t *references, size_t count,
                         const bool *values) {
    bool any = false;

    for (size_t i = 0; i < count; i++) {
        any |= values[i];
    }
    clocks_ask(me, references, count, values);
    return any && me->memory.mode == IN_CONTINUOUS_TIME ? solver_enter_events(me) : STATUS_OK;
}

/* New values of inputs and parameters are an event: they may jump. */
Status solved_set(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, const void *values, size_t size) {
    Solved *me = component;
    const Fmi *fmi = fmi_of(&me->solver);
    Status status = STATUS_OK;

    if (type == TYPE_CLOCK) {
        return set_clocks(&me->solver, references, count, values);
    }
    if (me->solver.memory.mode != BEFORE_EVENTS) {
        if (is_repeated(&me->last[type], references, count, values, size * value_size(fmi, type))) {
            return STATUS_OK;
        }
        if (me->solver.memory.mode == IN_CONTINUOUS_TIME) {
            status = solver_enter_events(&me->solver);
        }
    }
    if (good(status) && me->solver.solving->number_of_clocked > 0 &&
        me->solver.memory.mode != BEFORE_EVENTS) {
        status = set_one_by_one(me, type, SIZE_MAX);
    } else if (good(status)) {
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

Status solved_derive(const Library *library, void *component, const Derivation *derivation,
                     double *values) {
    const Solver *me = component;
    const Fmi *fmi = fmi_of(me);

    return fmi->derive == NULL ? STATUS_ERROR
                               : fmi->derive(library, me->component, derivation, values);
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
        saved = malloc(sizeof *saved + solver_size_of_ticks(me));
        free(saved == NULL ? NULL : old);
    }
    if (saved == NULL) {
        return STATUS_ERROR;
    }
    saved->state = inner;
    saved->memory = me->memory;
    memcpy(saved->ticks, me->ticks, solver_size_of_ticks(me));
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
    memcpy(me->ticks, saved->ticks, solver_size_of_ticks(me));
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

/* Of what is serialized beside the FMU's state. */
static size_t size_of_memory(const Solver *me) {
    return sizeof(Memory) + solver_size_of_ticks(me);
}

size_t solved_state_size(const Library *library, void *component, void *state) {
    const Solver *me = component;
    const SolvedState *saved = state;
    const size_t size = fmi_of(me)->state_size(library, me->component, saved->state);
    return size == 0 ? 0 : size + size_of_memory(me);
}

Status solved_serialize(const Library *library, void *component, void *state, char *bytes,
                        size_t size) {
    const Solver *me = component;
    const SolvedState *saved = state;

    const size_t own = size_of_memory(me);
    memcpy(bytes, &saved->memory, sizeof(Memory));
    memcpy(bytes + sizeof(Memory), saved->ticks, solver_size_of_ticks(me));
    return fmi_of(me)->serialize(library, me->component, saved->state, bytes + own, size - own);
}

Status solved_deserialize(const Library *library, void *component, const char *bytes, size_t size,
                          void **state) {
    const Solver *me = component;
    const size_t own = size_of_memory(me);
    SolvedState *saved = size < own ? NULL : calloc(1, sizeof *saved + solver_size_of_ticks(me));

    if (saved == NULL) {
        return STATUS_ERROR;
    }
    memcpy(&saved->memory, bytes, sizeof(Memory));
    memcpy(saved->ticks, bytes + sizeof(Memory), solver_size_of_ticks(me));
    const Status status = fmi_of(me)->deserialize(library, me->component, bytes + own, size - own,
                                                  &saved->state);
    *state = saved;
    if (!good(status)) {
        free(saved);
        *state = NULL;
    }
    return status;
}
