/* An agent as the instance of an FMU, for all FMI versions.
 *
 * A sample is taken at the beginning of a communication step, with the inputs that the importer has
 * set before. Its actions hold until the next sample. A communication step may be shorter or longer
 * than the time between two samples. In the initialization, outputs show what the first one gives. */

#ifndef FMU_INSTANCE_H
#define FMU_INSTANCE_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmu_model.h"

/* A sample is due if it lies this part of its time before the end of a step: times are rounded. */
#define TOLERANCE 1e-6

typedef enum { INSTANTIATED, INITIALIZATION, STEPPING, TERMINATED } Mode;

/* All that the state of the FMU consists of. */
typedef struct {
    AGENT_STATE agent;
    double measurements[MEASUREMENTS + 1]; /* one more: an array has an element at least */
    double actions[ACTIONS + 1];
    double start, time;
    long long samples;
    Mode mode;
} Memory;

typedef struct {
    Memory memory;
    char *name;
    void *logger, *environment;
    void (*emit)(const void *instance, const char *message);
} Controller;

static bool fail(const Controller *controller, const char *message) {
    if (controller->emit != NULL) {
        controller->emit(controller, message);
    }
    return false;
}

static void begin(Controller *controller) {
    Memory *memory = &controller->memory;
    memset(memory, 0, sizeof *memory); /* padding, too: states are compared as bytes */
    AGENT_INIT(&memory->agent);
    for (size_t i = 0; i < MEASUREMENTS; i++) {
        memory->measurements[i] = first_measurements[i];
    }
}

static Controller *create(const char *name, const char *token) {
    if (token == NULL || strcmp(token, TOKEN) != 0) {
        return NULL;
    }
    Controller *controller = calloc(1, sizeof *controller);
    if (controller == NULL) {
        return NULL;
    }
    name = name == NULL ? "" : name;
    controller->name = malloc(strlen(name) + 1);
    if (controller->name == NULL) {
        free(controller);
        return NULL;
    }
    strcpy(controller->name, name);
    begin(controller);
    return controller;
}

static void destroy(Controller *controller) {
    if (controller != NULL) {
        free(controller->name);
        free(controller);
    }
}

/* Variables. The reference 0 is the time; measurements, actions and parameters follow. */

static bool has_kind(const Controller *controller, unsigned reference, char kind) {
    if (reference < sizeof kinds - 1 && kinds[reference] == kind) {
        return true;
    }
    return fail(controller, "there is no variable of this type with this value reference");
}

static bool sample(const Controller *controller, AGENT_STATE *agent, double *actions) {
    if (AGENT_STEP(agent, controller->memory.measurements, actions) == 0) {
        return true;
    }
    return fail(controller, "a measurement is not finite, or outside of a table");
}

static bool get_action(const Controller *controller, unsigned place, double *value) {
    double actions[ACTIONS + 1];
    if (controller->memory.mode >= STEPPING) {
        *value = controller->memory.actions[place];
        return true;
    }
    AGENT_STATE agent = controller->memory.agent;
    if (!sample(controller, &agent, actions)) {
        return false;
    }
    *value = actions[place];
    return true;
}

/* The outputs keep what the initialization has led to until the first step. A plant has taken its
 * first sample then, and a controller takes it in the first step. */
static bool end_initialization(Controller *controller) {
    AGENT_STATE agent = controller->memory.agent;
    if (!sample(controller, &agent, controller->memory.actions)) {
        return false;
    }
    if (IS_PLANT) {
        controller->memory.agent = agent;
    }
    controller->memory.mode = STEPPING;
    return true;
}

static bool get_value(const Controller *controller, unsigned reference, char kind, double *value) {
    if (!has_kind(controller, reference, kind)) {
        return false;
    }
    if (reference > MEASUREMENTS + ACTIONS) {
        *value = get_parameter(&controller->memory.agent, reference - 1 - MEASUREMENTS - ACTIONS);
    } else if (reference > MEASUREMENTS) {
        return get_action(controller, reference - 1 - MEASUREMENTS, value);
    } else {
        const Memory *memory = &controller->memory;
        *value = reference == 0 ? memory->time : memory->measurements[reference - 1];
    }
    return true;
}

static bool set_value(Controller *controller, unsigned reference, char kind, double value) {
    if (!has_kind(controller, reference, kind)) {
        return false;
    }
    if (reference >= 1 && reference <= MEASUREMENTS) {
        controller->memory.measurements[reference - 1] = value;
        return true;
    }
    if (reference <= MEASUREMENTS + ACTIONS) {
        return fail(controller, "time and outputs cannot be set");
    }
    const unsigned place = reference - 1 - MEASUREMENTS - ACTIONS;
    if (is_fixed[place] && controller->memory.mode == STEPPING) {
        return fail(controller, "a fixed parameter cannot be set after the initialization");
    }
    set_parameter(&controller->memory.agent, place, value);
    return true;
}

/* Steps */

static bool step(Controller *controller, double time, double size) {
    Memory *memory = &controller->memory;
    const double end = time + size;

    if (memory->mode != STEPPING) {
        return fail(controller, "a step needs an initialized instance");
    }
    if (!(size > 0) || !isfinite(end)) {
        return fail(controller, "the communication step size must be positive");
    }
    while (memory->start + (double)memory->samples * SAMPLE_TIME < end - TOLERANCE * SAMPLE_TIME) {
        if (!sample(controller, &memory->agent, memory->actions)) {
            return false;
        }
        memory->samples++;
    }
    memory->time = end;
    return true;
}

/* States */

static bool remember(const Controller *controller, void **state) {
    if (*state == NULL) {
        *state = malloc(sizeof(Memory));
    }
    if (*state == NULL) {
        return fail(controller, "there is no memory for a state");
    }
    memcpy(*state, &controller->memory, sizeof(Memory));
    return true;
}

static bool recall(Controller *controller, const void *state) {
    if (state == NULL) {
        return fail(controller, "there is no such state");
    }
    memcpy(&controller->memory, state, sizeof(Memory));
    return true;
}

static bool copy_bytes(const Controller *controller, void *to, const void *from, size_t size) {
    if (to == NULL || from == NULL || size != sizeof(Memory)) {
        return fail(controller, "the bytes of a state have another size");
    }
    memcpy(to, from, size);
    return true;
}

/* The functions that are the same in FMI 2.0 and 3.0. Whoever includes this tells how their names
 * begin and are written, and whether arrays of values tell their length. */

#define OR_ERROR(done) ((done) ? FMI(OK) : FMI(Error))

/* The functions that get and set the variables of a type. */
#define ACCESS(Type, kind)                                                                         \
    FMI(Status) FMI(Get##Type)(void *c, const FMI(ValueReference) references[], size_t n,          \
                               FMI(Type) values[] AND_LENGTH) {                                    \
        for (size_t i = 0; i < n; i++) {                                                           \
            double value = 0.0;                                                                    \
            if (!FITS || !get_value(c, references[i], kind, &value)) {                             \
                return FMI(Error);                                                                 \
            }                                                                                      \
            values[i] = (FMI(Type))(kind == '?' ? value != 0.0 : value);                           \
        }                                                                                          \
        return FMI(OK);                                                                            \
    }                                                                                              \
    FMI(Status) FMI(Set##Type)(void *c, const FMI(ValueReference) references[], size_t n,          \
                               const FMI(Type) values[] AND_LENGTH) {                              \
        for (size_t i = 0; i < n; i++) {                                                           \
            if (!FITS || !set_value(c, references[i], kind, (double)values[i])) {                  \
                return FMI(Error);                                                                 \
            }                                                                                      \
        }                                                                                          \
        return FMI(OK);                                                                            \
    }

/* A function of values of a kind that no variable has. */
#define OF_NONE(name, ...)                                                                         \
    FMI(Status) FMI(name)(void *c, const FMI(ValueReference) references[], size_t n,               \
                          __VA_ARGS__) {                                                           \
        return OR_ERROR(n == 0);                                                                   \
    }

void FMI(FreeInstance)(void *c) {
    destroy(c);
}

FMI(Status) FMI(ExitInitializationMode)(void *c) {
    return OR_ERROR(end_initialization(c));
}

FMI(Status) FMI(Terminate)(void *c) {
    ((Controller *)c)->memory.mode = TERMINATED;
    return FMI(OK);
}

FMI(Status) FMI(Reset)(void *c) {
    begin(c);
    return FMI(OK);
}

FMI(Status) OF_STATE(Get, )(void *c, void **state) {
    return OR_ERROR(remember(c, state));
}

FMI(Status) OF_STATE(Set, )(void *c, void *state) {
    return OR_ERROR(recall(c, state));
}

FMI(Status) OF_STATE(Free, )(void *c, void **state) {
    free(*state);
    *state = NULL;
    return FMI(OK);
}

FMI(Status) OF_STATE(Serialized, Size)(void *c, void *state, size_t *size) {
    *size = sizeof(Memory);
    return FMI(OK);
}

FMI(Status) OF_STATE(Serialize, )(void *c, void *state, FMI(Byte) bytes[], size_t size) {
    return OR_ERROR(copy_bytes(c, bytes, state, size));
}

FMI(Status) DESERIALIZE(void *c, const FMI(Byte) bytes[], size_t size, void **state) {
    *state = NULL;
    const bool has_memory = remember(c, state);
    return OR_ERROR(has_memory && copy_bytes(c, *state, bytes, size));
}

#endif
