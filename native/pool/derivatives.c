/* Directional and adjoint derivatives of the instances of a pool. */

#include "pool/derivatives.h"

#include <stdlib.h>
#include <string.h>

#include "pool/failures.h"
#include "pool/steps.h"
#include "system/system.h"

/* The value references of the others, each array once, where the variables are in their values, and
 * scratch memory. */
typedef struct {
    uint32_t *references;
    size_t *places;
    size_t count, size;
    double *values, *seed, *inputs;
} Room;

static void find_places(const Access *access, Room *room) {
    for (size_t i = 0; i < access->count; i++) {
        const Element *one = &access->variables[i];
        size_t j = one->size > 1 ? 0 : i;
        while (j < i && access->variables[j].reference != one->reference) {
            j++;
        }
        if (j < i) {
            room->places[i] = room->places[j] - access->variables[j].place + one->place;
        } else {
            room->references[room->count++] = one->reference;
            room->places[i] = room->size + one->place;
            room->size += one->size;
        }
    }
}

static size_t largest(const Access *access) {
    size_t size = 0;

    for (size_t i = 0; i < access->count; i++) {
        size = access->variables[i].size > size ? access->variables[i].size : size;
    }
    return size;
}

static void close_room(Room *room) {
    free(room->references);
    free(room->places);
    free(room->values);
}

/* Returns whether there was enough memory. */
static bool open_room(Room *room, const Question *q, const Access *inputs) {
    const size_t seeds = largest(q->seeded), count = q->others->count;

    *room = (Room){.references = malloc((count + 1) * sizeof(uint32_t)),
                   .places = malloc((count + 1) * sizeof(size_t))};
    if (room->references == NULL || room->places == NULL) {
        return false;
    }
    find_places(q->others, room);
    const size_t size = room->size + seeds + inputs->count + inputs->width;
    room->values = calloc(size + 1, sizeof(double));
    if (room->values == NULL) {
        return false;
    }
    room->seed = room->values + room->size;
    room->inputs = room->seed + seeds;
    return true;
}

static Status derive(const Settings *s, const Instance *me, size_t part, const Derivation *one,
                     double *values) {
    if (s->system != NULL) {
        return part_derive(me->component, part, one, values);
    }
    return s->fmi->derive == NULL ? STATUS_ERROR
                                  : s->fmi->derive(me->library, me->component, one, values);
}

/* Differentiates with one seeded variable; the values of the others follow each other. */
static Status derive_by(Pool *pool, const Instance *me, const Question *q, const Element *seeded,
                        const Room *room) {
    const Derivation one = {
        .adjoint = q->adjoint,
        .unknowns = q->adjoint ? &seeded->reference : room->references,
        .number_of_unknowns = q->adjoint ? 1 : room->count,
        .knowns = q->adjoint ? room->references : &seeded->reference,
        .number_of_knowns = q->adjoint ? room->count : 1,
        .seed = room->seed,
        .size_of_seed = seeded->size,
        .size_of_values = room->size,
    };

    memset(room->seed, 0, seeded->size * sizeof *room->seed);
    room->seed[seeded->place] = 1.0;
    const Status status = derive(&pool->settings, me, q->part, &one, room->values);
    floats_restore_if_seen(&pool->floats);
    return status;
}

static Status fail(Pool *pool, Instance *me, const Question *q, const Element *seeded,
                   Status status) {
    const char *doing = q->adjoint ? "the derivative of" : "the derivative by";

    instance_fail(pool, me, pool->settings.system == NULL ? doing : "a derivative", status);
    if (me->failure != NULL && pool->settings.system == NULL) {
        me->failure->reference = seeded->reference;
    }
    return status;
}

static Status differentiate(Pool *pool, Instance *me, const Question *q, const Room *room,
                            double *derivatives) {
    for (size_t i = 0; i < q->seeded->count; i++) {
        const Element *seeded = &q->seeded->variables[i];
        const Status status = derive_by(pool, me, q, seeded, room);
        if (status > STATUS_WARNING) {
            return fail(pool, me, q, seeded, status);
        }
        for (size_t j = 0; j < q->others->count; j++, derivatives += pool->settings.count) {
            *derivatives = room->values[room->places[j]];
        }
    }
    return STATUS_OK;
}

static Status differentiate_at_inputs(Pool *pool, size_t index, Matrix inputs, const Question *q,
                                      const Room *room, double *derivatives) {
    Instance *me = &pool->instances[index];
    const Access *list = pool->settings.inputs;

    if (me->phase != PHASE_STEPPING) {
        return instance_refuse(me, "the instance needs a reset before it can be differentiated");
    }
    matrix_gather(&inputs, index, list->count, room->inputs);
    const Status status = access_set(list, me->library, me->component, room->inputs,
                                     room->inputs + list->count, &pool->floats);
    return status > STATUS_WARNING ? instance_fail(pool, me, "setting the inputs", status)
                                   : differentiate(pool, me, q, room, derivatives);
}

ptrdiff_t pool_differentiate(Pool *pool, Matrix inputs, const Question *question,
                             double *derivatives) {
    Room room;
    ptrdiff_t failed = -1;

    if (!open_room(&room, question, pool->settings.inputs)) {
        instance_refuse(&pool->instances[0], "out of memory");
        failed = 0;
    }
    for (size_t i = 0; i < pool->settings.count && failed < 0; i++) {
        if (differentiate_at_inputs(pool, i, inputs, question, &room, derivatives + i) >
            STATUS_WARNING) {
            failed = (ptrdiff_t)i;
        }
    }
    close_room(&room);
    return failed;
}
