#include "single.h"

#include <float.h>
#include <math.h>
#include <string.h>

#include "steps.h"

enum { DONE, TRUNCATED, REWARD };

static Source source_of(const Single *s, const char *actions, const char *previous) {
    return (Source){.actions = actions,
                    .previous_actions = previous,
                    .action_size = s->size,
                    .action_elements = s->elements,
                    .seen = s->seen};
}

static bool make_inputs(const Pool *pool, const Single *s) {
    const Source source = source_of(s, s->next, s->current);
    const size_t count = pool->settings.inputs->count;
    Notes notes = {.outside = false};

    program_run(&s->inputs, &source, 0, 1, s->input_registers, &notes);
    if (notes.outside || !are_finite(s->wanted, count)) {
        return false;
    }
    memcpy(s->inputs_row, s->wanted, count * sizeof *s->wanted);
    return true;
}

static void keep_what_was(const Pool *pool, const Single *s) {
    const size_t bytes = s->elements * s->size;

    memcpy(s->previous, s->current, bytes);
    memcpy(s->current, s->next, bytes);
    memcpy(s->kept, pool->settings.output_values, pool->settings.outputs->count * sizeof *s->kept);
    for (size_t i = 0; i < s->number_of_rows; i++) {
        memcpy(s->rows[i].before, s->rows[i].now, s->rows[i].size);
    }
}

/* Values beyond a float32 make an observation that is not finite. */
static bool fits_observation(const Pool *pool, const Single *s) {
    const Settings *settings = &pool->settings;

    return !s->observed ||
           all_within(settings->output_values, settings->outputs->count, FLOAT32_LIMIT);
}

static bool judge(const Pool *pool, const Single *s, SingleResult *result) {
    const Source source = source_of(s, s->current, s->previous);
    const void **places = s->judgement_registers->places;
    const uint16_t *results = s->judgement.results;
    Notes notes = {.outside = false};

    program_run(&s->judgement, &source, 0, 1, s->judgement_registers, &notes);
    result->terminated = *(const uint8_t *)places[results[DONE]] != 0;
    result->truncated = *(const uint8_t *)places[results[TRUNCATED]] != 0 ||
                        *s->step_count >= s->limit;
    result->reward = *(const double *)places[results[REWARD]];
    return !notes.outside && notes.not_finite[0] == 0 && fabs(result->reward) <= DBL_MAX &&
           fits_observation(pool, s);
}

bool single_before(const Pool *pool, const Single *single) {
    if (!make_inputs(pool, single)) {
        return false;
    }
    keep_what_was(pool, single);
    return true;
}

SingleOutcome single_after(const Pool *pool, const Single *single, size_t troubled,
                           SingleResult *result) {
    ++*single->step_count; /* whatever becomes of the step */
    return troubled == 0 && judge(pool, single, result) ? SINGLE_DONE : SINGLE_TROUBLED;
}

SingleOutcome single_step(Pool *pool, const Single *single, const Call *call,
                          SingleResult *result) {
    if (!single_before(pool, single)) {
        return SINGLE_REFUSED;
    }
    return single_after(pool, single, pool_step(pool, call), result);
}
