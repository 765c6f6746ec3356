/* A task of threads: statuses that they note, and observations that they write. */

#include "pool/task.h"

#include "pool/instances.h"

size_t note_status(Task *task, size_t index, Status status) {
    task->pool->settings.status[index] = (int8_t)status;
    if (status <= STATUS_WARNING) {
        return 0;
    }
    health_count_fault(task->pool, &task->pool->instances[index], status);
    return 1;
}

void write_observation(const Pool *pool, size_t index, float *observations) {
    const Settings *s = &pool->settings;
    const double *value = s->output_values + index;
    float *row = observations + index * s->num_observed;

    for (size_t i = 0; i < s->num_observed; i++, value += s->count) {
        row[i] = (float)*value;
    }
}

void write_all_observations(const Pool *pool, float *observations) {
    const Settings *s = &pool->settings;
    const double *values = s->output_values;
    const size_t count = s->count, width = s->num_observed;

    for (size_t i = 0; i < width; i++, values += count) {
        for (size_t j = 0; j < count; j++) {
            observations[j * width + i] = (float)values[j];
        }
    }
}
