#include "derivatives.h"

#include <stdlib.h>
#include <string.h>

#include "../failures.h"

/* The value references of variables, each array once, and where the variables are in the values. */
typedef struct {
    uint32_t *references;
    size_t *places;
    size_t count, size;
} Layout;

static Layout layout_of(const Access *access) {
    Layout all = {.references = memory_for(NULL, access->count * sizeof(uint32_t)),
                  .places = memory_for(NULL, access->count * sizeof(size_t))};

    for (size_t i = 0; i < access->count; i++) {
        const Element *one = &access->variables[i];
        size_t j = one->size > 1 ? 0 : i;
        while (j < i && access->variables[j].reference != one->reference) {
            j++;
        }
        if (j < i) {
            all.places[i] = all.places[j] - access->variables[j].place + one->place;
        } else {
            all.references[all.count++] = one->reference;
            all.places[i] = all.size + one->place;
            all.size += one->size;
        }
    }
    return all;
}

static Status set_inputs(Worker *w, Instance *me) {
    const Access *inputs = &w->inputs;
    const size_t index = index_of(&w->pool, me);
    double *memory = memory_for(NULL, (inputs->count + inputs->width) * sizeof *memory);

    for (size_t i = 0; i < inputs->count; i++) {
        memory[i] = w->shared.inputs[i * w->shared.stride + index];
    }
    const Status status = access_set(inputs, me->library, me->component, memory,
                                     memory + inputs->count, &w->pool.floats);
    free(memory);
    return status;
}

/* Differentiates with one seeded variable; the values of the others follow each other. */
static Status derive(Worker *w, Instance *me, bool adjoint, const Element *seeded,
                     const Layout *others, double *values) {
    const Fmi *fmi = w->settings.fmi;
    double *seed = memory_for(NULL, seeded->size * sizeof *seed);
    const Derivation one = {
        .adjoint = adjoint,
        .unknowns = adjoint ? &seeded->reference : others->references,
        .number_of_unknowns = adjoint ? 1 : others->count,
        .knowns = adjoint ? others->references : &seeded->reference,
        .number_of_knowns = adjoint ? others->count : 1,
        .seed = seed,
        .size_of_seed = seeded->size,
        .size_of_values = others->size,
    };

    memset(seed, 0, seeded->size * sizeof *seed);
    seed[seeded->place] = 1.0;
    const Status status =
        fmi->derive == NULL ? STATUS_ERROR : fmi->derive(me->library, me->component, &one, values);
    floats_restore_if_seen(&w->pool.floats);
    free(seed);
    return status;
}

static Status differentiate(Worker *w, Instance *me, const Question *q, const Layout *layout,
                            double *derivatives) {
    double *values = memory_for(NULL, layout->size * sizeof *values);
    Status status = STATUS_OK;

    memset(values, 0, layout->size * sizeof *values);
    for (size_t i = 0; i < q->seeded->count && status <= STATUS_WARNING; i++) {
        status = derive(w, me, q->adjoint, &q->seeded->variables[i], layout, values);
        for (size_t j = 0; j < q->others->count; j++, derivatives += w->settings.count) {
            *derivatives = values[layout->places[j]];
        }
    }
    free(values);
    return status > STATUS_WARNING ? instance_fail(&w->pool, me, "a derivative", status) : status;
}

static Status differentiate_at_inputs(Worker *w, Instance *me, const Question *q,
                                      const Layout *layout, double *derivatives) {
    if (me->phase != PHASE_STEPPING) {
        return instance_refuse(me, "the instance needs a reset before it can be differentiated");
    }
    const Status status = set_inputs(w, me);
    return status > STATUS_WARNING ? instance_fail(&w->pool, me, "setting the inputs", status)
                                   : differentiate(w, me, q, layout, derivatives);
}

ptrdiff_t worker_differentiate(Worker *w, const Question *question, double *derivatives) {
    const Layout layout = layout_of(question->others);
    ptrdiff_t failed = -1;

    for (size_t i = 0; i < w->settings.count && failed < 0; i++) {
        Instance *me = &w->pool.instances[i];
        if (differentiate_at_inputs(w, me, question, &layout, derivatives + i) > STATUS_WARNING) {
            failed = (ptrdiff_t)i;
        }
    }
    free(layout.references);
    free(layout.places);
    return failed;
}
