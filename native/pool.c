/* The pool: its instances, what it does with them, and how the work is divided among threads. */

#include "pool.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "floats.h"
#include "threads.h"

static const double PARALLEL_FROM = 20e3; /* ns of work for which waking a helper pays */
static const double QUICK = 10e3;         /* ns for which others may wait */
static const double SMALLEST_CHUNK = 2e3; /* ns */
static const double LARGEST_CHUNK = 50e3; /* ns */
static const size_t STATES_LIMIT = (size_t)256 << 20; /* bytes of initial states of one pool */

enum {
    STACK_VALUES = 512,
    RUN = PROGRAM_WIDTH, /* instances of a run */
    MANY = 64,         /* instances from which on every call is measured */
    MEASURE_EVERY = 16 /* calls with fewer */
};

static const char *const BAD_INPUTS = "the inputs are not finite";
static const char *const BAD_OUTPUTS = "the outputs are not finite";

/* Which pools a thread is inside of: an FMU written in Python that calls its own pool gets an error
 * instead of waiting for itself. */

enum { NESTED = 8 }; /* deeper ones are not noticed */

static THREAD_LOCAL struct {
    const Pool *pools[NESTED];
    size_t depth;
} inside;

static void begin_inside(const Pool *pool) {
    if (inside.depth < NESTED) {
        inside.pools[inside.depth] = pool;
    }
    inside.depth++;
}

static void end_inside(void) {
    inside.depth--;
}

static bool is_inside(const Pool *pool) {
    for (size_t i = 0; i < inside.depth && i < NESTED; i++) {
        if (inside.pools[i] == pool) {
            return true;
        }
    }
    return false;
}

/* Failures */

static char *copy_text(const char *text) {
    const size_t size = text == NULL ? 0 : strlen(text) + 1;
    char *copy = size == 0 ? NULL : malloc(size);
    if (copy != NULL) {
        memcpy(copy, text, size);
    }
    return copy;
}

static double *copy_values(const double *values, size_t count) {
    double *copy = values == NULL ? NULL : malloc(count * sizeof *copy);
    if (copy != NULL) {
        memcpy(copy, values, count * sizeof *copy);
    }
    return copy;
}

static void drop_failure(Instance *me) {
    if (me->failure != NULL) {
        free(me->failure->said);
        free(me->failure->values);
        free(me->failure);
        me->failure = NULL;
    }
}

/* Without memory there is a status and no reason. */
static Failure *note_failure(Instance *me, const char *doing, int status) {
    drop_failure(me);
    me->failure = calloc(1, sizeof *me->failure);
    if (me->failure != NULL) {
        me->failure->doing = doing;
        me->failure->status = status;
        me->failure->time = NAN;
        me->failure->string_reference = UINT32_MAX;
    }
    return me->failure;
}

static Status judge(Instance *me, Status status) {
    if (status == STATUS_FATAL) {
        me->phase = PHASE_DEAD;
    } else if (status == STATUS_ERROR) {
        me->phase = PHASE_FAILED;
    }
    return status;
}

static size_t index_of(const Pool *pool, const Instance *me) {
    return (size_t)(me - pool->instances);
}

/* Health */

static int64_t *health_of(const Pool *pool, const Instance *me) {
    return pool->settings.health + index_of(pool, me) * HEALTH_COUNTS;
}

static void count_fault(const Pool *pool, const Instance *me, Status status) {
    if (status == STATUS_DISCARD) {
        health_of(pool, me)[DISCARDS]++;
    } else if (status == STATUS_ERROR) {
        health_of(pool, me)[ERRORS]++;
    } else if (status == STATUS_FATAL) {
        health_of(pool, me)[FATALS]++;
    } else if (status == STATUS_NOT_FINITE) {
        health_of(pool, me)[NOT_FINITE]++;
    }
}

/* Steps count themselves; these are taken over now and then. */
static void count_steps(const Pool *pool, Instance *me) {
    health_of(pool, me)[STEPS] += me->steps - me->counted;
    me->counted = me->steps;
}

static void begin_counting_at(Instance *me, int64_t steps) {
    me->steps = me->counted = steps;
}

/* A call returned a bad status: note which calls are still legal, and why. */
static Status fail(Pool *pool, Instance *me, const char *doing, Status status) {
    Failure *failure = note_failure(me, doing, status);
    if (failure != NULL) {
        failure->said = log_said(&pool->log, index_of(pool, me));
    }
    return judge(me, status);
}

/* A call was not even made. */
static Status refuse(Instance *me, const char *reason) {
    note_failure(me, reason, -1);
    return me->phase == PHASE_DEAD ? STATUS_FATAL : STATUS_ERROR;
}

/* Instances */

static const char *name_of(const Pool *pool, size_t index) {
    return pool->names + index * pool->name_size;
}

static bool build(Pool *pool, Instance *me) {
    const Settings *s = &pool->settings;
    const size_t index = index_of(pool, me);
    const Identity identity = {name_of(pool, index), s->token, s->resources,
                               log_environment(&pool->log, index), s->logging};

    const Floats floats = floats_now();

    mutex_lock(&pool->making);
    me->component = s->fmi->instantiate(me->library, &identity);
    mutex_unlock(&pool->making);
    floats_restore(&floats);
    me->phase = me->component == NULL ? PHASE_DEAD : PHASE_INSTANTIATED;
    return me->component != NULL;
}

static Status free_state(const Pool *pool, Instance *me, void **state) {
    const Floats floats = floats_now();
    Status status = STATUS_OK;

    if (*state != NULL && me->phase != PHASE_DEAD) {
        status = judge(me, pool->settings.fmi->free_state(me->library, me->component, state));
        floats_restore(&floats);
    }
    *state = NULL; /* after Fatal the standard forbids to free it: the memory is given up */
    return status;
}

/* Snapshots are linked and unlinked under the pool's lock, but instances are replaced by several
 * threads; each of these touches only what is its own instance's. */
static void free_states(Pool *pool, Instance *me) {
    const size_t index = index_of(pool, me);

    free_state(pool, me, &me->saved);
    for (Snapshot *snapshot = pool->snapshots; snapshot != NULL; snapshot = snapshot->next) {
        if (snapshot->generations[index] == me->generation) {
            free_state(pool, me, &snapshot->states[index]);
        }
    }
}

static void discard(Pool *pool, Instance *me) {
    const Fmi *fmi = pool->settings.fmi;
    const Floats floats = floats_now();

    free_states(pool, me);
    if (me->phase == PHASE_STEPPING || me->phase == PHASE_ENDED) {
        judge(me, fmi->terminate(me->library, me->component));
    }
    if (me->phase != PHASE_DEAD) {
        mutex_lock(&pool->making);
        fmi->free_instance(me->library, me->component);
        mutex_unlock(&pool->making);
    }
    floats_restore(&floats);
    me->component = NULL;
    me->phase = PHASE_DEAD;
    me->generation++;
    me->start_id = 0;
    me->unsavable = false;
    log_forget(&pool->log, index_of(pool, me));
}

/* A private library may be loaded anew: whatever Fatal left in its globals is gone then. */
static void reload_private_library(Pool *pool, Instance *me) {
    const Settings *s = &pool->settings;
    const Floats floats = floats_now(); /* code runs when a library is loaded, too */
    char unused[256];

    if (s->private_libraries) {
        library_close(me->library);
        if (library_open(me->library, s->paths[index_of(pool, me)], unused, sizeof unused) &&
            !s->fmi->bind(me->library, unused, sizeof unused)) {
            library_close(me->library);
        }
    }
    floats_restore(&floats);
}

static Status rebuild(Pool *pool, Instance *me) {
    const bool was_dead = me->phase == PHASE_DEAD;

    discard(pool, me);
    if (was_dead || pool->settings.reloads) {
        reload_private_library(pool, me);
    }
    const bool loaded = me->library->functions != NULL;
    if (loaded && build(pool, me)) {
        return STATUS_OK;
    }
    Failure *failure = note_failure(me, loaded ? "the FMU refused to be instantiated anew"
                                               : "the FMU's library cannot be loaded anew", -1);
    if (failure != NULL) {
        failure->said = log_said(&pool->log, index_of(pool, me));
    }
    return STATUS_FATAL;
}

static Status replace(Pool *pool, Instance *me) {
    health_of(pool, me)[REPLACEMENTS]++;
    return rebuild(pool, me);
}

/* Returns to the state just after instantiation: resets, or replaces what refuses or is past any
 * reset. */
static Status return_to_instantiated(Pool *pool, Instance *me) {
    if (me->phase == PHASE_INSTANTIATED) {
        return STATUS_OK;
    }
    if (me->phase != PHASE_DEAD) {
        const Floats floats = floats_now();
        const Status status = pool->settings.fmi->reset(me->library, me->component);
        floats_restore(&floats);
        if (status <= STATUS_WARNING) {
            me->phase = PHASE_INSTANTIATED;
            return STATUS_OK;
        }
        judge(me, status);
    }
    return replace(pool, me);
}

/* Steps */

/* The order of operations of PoolSpec.communication_point; a division by 1 changes nothing. */
static double communication_point(const Pool *pool, const Instance *me) {
    const Settings *s = &pool->settings;
    const double since_start = (double)me->steps * s->time_step;
    return s->experiment.start_time +
           (s->substeps == 1 ? since_start : since_start / (double)s->substeps);
}

/* After a step that was not done FMI wants no other. */
static void forbid_steps(Instance *me) {
    if (me->phase == PHASE_STEPPING) {
        me->phase = PHASE_ENDED;
    }
}

static Status fail_step(Pool *pool, Instance *me, double time, Status status) {
    fail(pool, me, "the step", status);
    forbid_steps(me);
    if (me->failure != NULL) {
        me->failure->time = time;
    }
    return status;
}

/* A communication step as several smaller ones. */
static Status step_in_parts(Pool *pool, Instance *me, double time, int64_t parts) {
    const Settings *s = &pool->settings;
    const double size = pool->step_size / (double)parts;
    const Floats floats = floats_now();
    Status status = STATUS_OK;

    for (int64_t i = 0; i < parts && status <= STATUS_WARNING; i++) {
        status = s->fmi->do_step(me->library, me->component, time + (double)i * size, size,
                                 pool->no_return);
        floats_restore(&floats);
    }
    return status;
}

/* A discarded step leaves the instance where it may not be stepped on from: each try begins at the
 * state before the first one. */
static Status retry(Pool *pool, Instance *me, double time, void *before) {
    const Settings *s = &pool->settings;
    int64_t *health = health_of(pool, me);
    Status status = STATUS_DISCARD;

    for (int64_t i = 1; i <= s->retries && status == STATUS_DISCARD; i++) {
        const Floats floats = floats_now();
        const Status restored = s->fmi->set_state(me->library, me->component, before);
        floats_restore(&floats);
        if (restored > STATUS_WARNING) {
            return restored;
        }
        health[RETRIES]++;
        health[RETRIED]++;
        status = step_in_parts(pool, me, time, (int64_t)1 << i);
    }
    return status;
}

static Status step_with_retries(Pool *pool, Instance *me, double time) {
    void *before = NULL;
    const Floats floats = floats_now();
    Status status = pool->settings.fmi->get_state(me->library, me->component, &before);

    floats_restore(&floats);
    if (status > STATUS_WARNING) {
        return status;
    }
    status = step_in_parts(pool, me, time, 1);
    if (status == STATUS_DISCARD) {
        status = retry(pool, me, time, before);
    }
    judge(me, status);
    const Status freed = free_state(pool, me, &before);
    return status > STATUS_WARNING ? status : freed;
}

static Status step_once(Pool *pool, Instance *me) {
    const double time = communication_point(pool, me);
    const Status status = pool->settings.retries == 0 ? step_in_parts(pool, me, time, 1)
                                                      : step_with_retries(pool, me, time);

    me->steps++;
    return status > STATUS_WARNING ? fail_step(pool, me, time, status) : status;
}

static Status advance(Pool *pool, Instance *me) {
    Status status = STATUS_OK;
    for (int64_t i = 0; i < pool->settings.substeps && status <= STATUS_WARNING; i++) {
        status = step_once(pool, me);
    }
    return status;
}

WIDE static bool all_finite(const double *values, size_t count) {
    int64_t bad = 0; /* as wide as the values, for the compiler's sake */

    for (size_t i = 0; i < count; i++) {
        bad |= !(fabs(values[i]) <= DBL_MAX);
    }
    return bad == 0;
}

static Status note_not_finite(Instance *me, const char *what, const double *values, size_t count) {
    Failure *failure = note_failure(me, what, -1);
    if (failure != NULL) {
        failure->values = copy_values(values, count);
        failure->number_of_values = count;
    }
    return STATUS_NOT_FINITE;
}

/* Scratch memory of one thread. */
typedef struct {
    double *values; /* of one instance, */
    void *typed;    /* and their typed form */
    double *inputs; /* of a run of instances, one after the other */
    double *outputs;
    bool sound;     /* whether these inputs are all finite */
    const Floats *floats; /* the environment that FMUs shall find */
} Scratch;

static void copy_outputs(const Pool *pool, const Instance *me, double *values) {
    const Settings *s = &pool->settings;
    const double *place = s->output_values + index_of(pool, me);

    for (size_t i = 0; i < s->outputs->count; i++, place += s->count) {
        values[i] = *place;
    }
}

static Status read_outputs(Pool *pool, Instance *me, Scratch scratch) {
    const Settings *s = &pool->settings;
    const size_t count = s->outputs->count;
    const Status got =
        access_get(s->outputs, me->library, me->component, scratch.values, scratch.typed);

    if (got > STATUS_WARNING) {
        return fail(pool, me, "reading the outputs", got);
    }
    if (!all_finite(scratch.values, count)) {
        return note_not_finite(me, BAD_OUTPUTS, scratch.values, count);
    }
    double *place = s->output_values + index_of(pool, me);
    for (size_t i = 0; i < count; i++, place += s->count) {
        *place = scratch.values[i];
    }
    return STATUS_OK;
}

static void gather(const Matrix *matrix, size_t column, size_t rows, double *values) {
    const char *place = matrix->data + (ptrdiff_t)column * matrix->column_stride;
    for (size_t i = 0; i < rows; i++, place += matrix->row_stride) {
        memcpy(&values[i], place, sizeof values[i]);
    }
}

static Status fail_reading(Pool *pool, Instance *me, Status status) {
    fail(pool, me, "reading the outputs", status);
    forbid_steps(me); /* the step before may have been the last */
    return status;
}

static Status fail_setting(Pool *pool, Instance *me, Status status) {
    return fail(pool, me, "setting the inputs", status);
}

static Status step_instance(Pool *pool, Instance *me, Scratch scratch) {
    const Settings *s = &pool->settings;

    if (me->phase != PHASE_STEPPING) {
        return refuse(me, "a step was asked for before a reset has mended the instance");
    }
    if (!scratch.sound && !all_finite(scratch.inputs, s->inputs->count)) {
        return note_not_finite(me, BAD_INPUTS, scratch.inputs, s->inputs->count);
    }
    if (s->retries > 0) {
        health_of(pool, me)[RETRIED] = 0;
    }
    const Status set =
        access_set(s->inputs, me->library, me->component, scratch.inputs, scratch.typed);
    if (set > STATUS_WARNING) {
        return fail_setting(pool, me, set);
    }
    const Status status = advance(pool, me);
    if (status > STATUS_WARNING && status != STATUS_TERMINATED) {
        return status;
    }
    const Status got =
        access_get(s->outputs, me->library, me->component, scratch.outputs, scratch.typed);
    return got > STATUS_WARNING ? fail_reading(pool, me, got) : status;
}

/* Initialization */

typedef struct {
    Pool *pool;
    Instance *me;
    const Access *start;
    Scratch scratch; /* holds the start values */
    uint32_t refused; /* the String that could not be set */
} StartContext;

static Status set_start_values(void *context) {
    StartContext *c = context;
    const Settings *s = &c->pool->settings;
    const Floats floats = floats_now();
    Status status = access_set(c->start, c->me->library, c->me->component, c->scratch.values,
                               c->scratch.typed);

    for (size_t i = 0; i < s->number_of_strings && status <= STATUS_WARNING; i++) {
        const StringValue *string = &s->strings[i];
        status = s->fmi->set_string(c->me->library, c->me->component, string->reference,
                                    string->text);
        floats_restore(&floats);
        c->refused = status > STATUS_WARNING ? string->reference : c->refused;
    }
    return status;
}

static Status fail_initialization(Pool *pool, Instance *me, const StartContext *context,
                                  const char *doing, Status status) {
    fail(pool, me, doing, status);
    if (me->failure != NULL) {
        me->failure->string_reference = context->refused;
    }
    if (me->phase == PHASE_INSTANTIATED) {
        me->phase = PHASE_FAILED; /* somewhere in the middle of it: a reset is due */
    }
    return status;
}

static Status warm_up(Pool *pool, Instance *me) {
    begin_counting_at(me, 0);
    for (int64_t i = 0; i < pool->settings.warm_up_steps; i++) {
        const Status status = advance(pool, me);
        begin_counting_at(me, me->steps);
        if (status > STATUS_WARNING) {
            if (me->failure != NULL) {
                me->failure->in_warm_up = true;
            }
            return status;
        }
    }
    return STATUS_OK;
}

static Status initialize(Pool *pool, Instance *me, const Access *start, Scratch scratch) {
    const Settings *s = &pool->settings;
    StartContext context = {pool, me, start, scratch, UINT32_MAX};
    const char *doing = "initialization";
    const Floats floats = floats_now();
    Status status = return_to_instantiated(pool, me);

    if (status > STATUS_WARNING) {
        return status;
    }
    status = s->fmi->initialize(me->library, me->component, &s->experiment,
                                (StartValues){set_start_values, &context}, &doing);
    floats_restore(&floats);
    if (status > STATUS_WARNING) {
        return fail_initialization(pool, me, &context, doing, status);
    }
    me->phase = PHASE_STEPPING;
    return warm_up(pool, me);
}

/* Initial states: kept once the same start values come a second time, after an episode with steps, and
 * restored from then on. */

static bool states_are_of_use(Pool *pool, const Instance *me) {
    return pool->settings.restores && !me->unsavable && !atomic_get(&pool->states_too_large);
}

static Status save_state(Pool *pool, Instance *me, void **state) {
    const Floats floats = floats_now();

    *state = NULL;
    const Status status = pool->settings.fmi->get_state(me->library, me->component, state);
    floats_restore(&floats);
    return status > STATUS_WARNING ? fail(pool, me, "saving the FMU state", status) : status;
}

static Status restore_state(Pool *pool, Instance *me, void *state) {
    if (me->phase == PHASE_DEAD) {
        return refuse(me, "no restore after a fatal error");
    }
    const Floats floats = floats_now();
    const Status status = pool->settings.fmi->set_state(me->library, me->component, state);
    floats_restore(&floats);
    if (status > STATUS_WARNING) {
        fail(pool, me, "restoring the FMU state", status);
        return me->phase == PHASE_DEAD ? STATUS_FATAL : STATUS_ERROR;
    }
    me->phase = PHASE_STEPPING;
    return status;
}

static bool too_large(Pool *pool, Instance *me) {
    const Settings *s = &pool->settings;
    const Floats floats = floats_now();
    const size_t size = s->fmi->state_size(me->library, me->component, me->saved);
    floats_restore(&floats);
    return size > STATES_LIMIT / s->count;
}

static void keep_state(Pool *pool, Instance *me) {
    if (save_state(pool, me, &me->saved) > STATUS_WARNING) {
        me->unsavable = true;
    } else if (too_large(pool, me)) {
        atomic_set(&pool->states_too_large, 1);
    }
}

static double *start_values_of(const Pool *pool, const Instance *me) {
    return pool->starts + index_of(pool, me) * pool->start_width;
}

static bool starts_as_before(const Pool *pool, const Instance *me, const Access *start,
                             const double *values) {
    const size_t size = start->count * sizeof *values;
    return me->start_id == start->id && memcmp(start_values_of(pool, me), values, size) == 0;
}

static Status start_anew(Pool *pool, Instance *me, const Call *call, bool again,
                         Scratch scratch) {
    const Access *start = call->start;
    free_state(pool, me, &me->saved);
    const Status status = initialize(pool, me, start, scratch);
    if (status > STATUS_WARNING) {
        return status;
    }
    again = again && me->start_id == start->id; /* it may have been replaced */
    me->start_id = start->id;
    memcpy(start_values_of(pool, me), scratch.values, start->count * sizeof(double));
    if (again && states_are_of_use(pool, me)) {
        keep_state(pool, me);
    }
    return me->phase == PHASE_STEPPING ? STATUS_OK : initialize(pool, me, start, scratch);
}

static Status restart(Pool *pool, Instance *me, const Call *call, bool again, Scratch scratch) {
    Status status = start_anew(pool, me, call, again, scratch);

    if (status > STATUS_WARNING) {
        return me->phase == PHASE_DEAD ? STATUS_FATAL : STATUS_ERROR;
    }
    begin_counting_at(me, pool->settings.warm_up_steps * pool->settings.substeps);
    return read_outputs(pool, me, scratch);
}

static Status return_to_start(Pool *pool, Instance *me, Scratch scratch) {
    const Status status = restore_state(pool, me, me->saved);

    if (status > STATUS_WARNING) {
        free_state(pool, me, &me->saved);
        me->unsavable = true;
        return status;
    }
    begin_counting_at(me, pool->settings.warm_up_steps * pool->settings.substeps);
    return read_outputs(pool, me, scratch);
}

/* Makes an instance anew that has leaked memory, or that no reset would make as new. */
static Status make_anew_if_due(Pool *pool, Instance *me) {
    const bool due = me->due;

    me->due = false;
    if (me->phase == PHASE_DEAD || me->phase == PHASE_INSTANTIATED) {
        return STATUS_OK;
    }
    if (due) {
        health_of(pool, me)[RECYCLINGS]++;
        return replace(pool, me);
    }
    return pool->settings.rebuilds ? rebuild(pool, me) : STATUS_OK;
}

/* By the reset method of the settings. */
static Status reset_instance(Pool *pool, Instance *me, const Call *call, Scratch scratch) {
    const Access *start = call->start;
    const Matrix *values = &call->start_values;
    const bool stepped = me->steps > pool->settings.warm_up_steps * pool->settings.substeps;

    count_steps(pool, me);
    health_of(pool, me)[RESETS]++;
    health_of(pool, me)[RETRIED] = 0;
    if (make_anew_if_due(pool, me) > STATUS_WARNING) {
        return STATUS_FATAL;
    }
    gather(values, index_of(pool, me), start->count, scratch.values);
    const bool again = starts_as_before(pool, me, start, scratch.values);

    if (!again || me->saved == NULL || me->phase == PHASE_DEAD || !states_are_of_use(pool, me)) {
        return restart(pool, me, call, again && stepped, scratch);
    }
    const Status status = return_to_start(pool, me, scratch);
    if (me->saved != NULL) {
        return status;
    }
    gather(values, index_of(pool, me), start->count, scratch.values); /* it refused */
    return restart(pool, me, call, again, scratch);
}

/* Division of the work */

typedef struct {
    Pool *pool;
    const Call *call;
    int operation;
    const Snapshot *snapshot; /* to be restored */
    bool listed;              /* whether the items are places in pool->chosen, or instances */
    bool measured;
    Atomic troubled; /* instances with a status worse than a warning */
    Atomic ended;    /* episodes, when playing */
    Atomic time;     /* ns, of all threads together, if measured */
} Task;

static bool is_in(Mask mask, size_t index) {
    return mask.data != NULL && mask.data[(ptrdiff_t)index * mask.stride] != 0;
}

static void write_observation(const Pool *pool, size_t index, float *observations) {
    const Settings *s = &pool->settings;
    const double *value = s->output_values + index;
    float *row = observations + index * s->num_observed;

    for (size_t i = 0; i < s->num_observed; i++, value += s->count) {
        row[i] = (float)*value;
    }
}

static Status restore_instance(Task *task, Instance *me, Scratch scratch) {
    const size_t index = index_of(task->pool, me);

    count_steps(task->pool, me);
    const Status status = restore_state(task->pool, me, task->snapshot->states[index]);
    if (status > STATUS_WARNING) {
        return status;
    }
    begin_counting_at(me, task->snapshot->steps[index]);
    return read_outputs(task->pool, me, scratch);
}

static size_t note_status(Task *task, size_t index, Status status) {
    task->pool->settings.status[index] = (int8_t)status;
    if (status <= STATUS_WARNING) {
        return 0;
    }
    count_fault(task->pool, &task->pool->instances[index], status);
    return 1;
}

/* Resets or restores instances that need not be neighbours. */
static size_t start_listed(Task *task, size_t begin, size_t end, Scratch scratch) {
    Pool *pool = task->pool;
    const Call *call = task->call;
    size_t troubled = 0;

    for (size_t i = begin; i < end; i++) {
        const size_t index = pool->chosen[i];
        Instance *me = &pool->instances[index];
        const Status status =
            task->operation == RESTORE
                ? restore_instance(task, me, scratch)
                : reset_instance(pool, me, call, scratch);
        troubled += note_status(task, index, status);
        if (call->observations != NULL) {
            write_observation(pool, index, call->observations);
        }
    }
    return troubled;
}

/* Runs: neighbours whose inputs and outputs are moved together, in loops that become vector
 * instructions. */

static void gather_inputs(const Task *task, size_t begin, size_t count, double *inputs) {
    const Matrix *matrix = &task->call->inputs;
    const size_t width = task->pool->settings.inputs->count;

    for (size_t i = 0; i < width; i++) {
        const char *place = matrix->data + (ptrdiff_t)i * matrix->row_stride +
                            (ptrdiff_t)begin * matrix->column_stride;
        double *to = inputs + i;
        for (size_t j = 0; j < count; j++, place += matrix->column_stride, to += width) {
            memcpy(to, place, sizeof *to);
        }
    }
}

/* Those that cannot be left as they are: their outputs stay as before. */
static size_t take_not_finite(Task *task, size_t begin, size_t count, double *outputs) {
    Pool *pool = task->pool;
    const size_t width = pool->settings.outputs->count;
    size_t troubled = 0;

    for (size_t j = 0; j < count; j++, outputs += width) {
        Instance *me = &pool->instances[begin + j];
        if (!all_finite(outputs, width)) {
            const bool counted = pool->settings.status[begin + j] > STATUS_WARNING;
            note_status(task, begin + j, note_not_finite(me, BAD_OUTPUTS, outputs, width));
            troubled += !counted;
            copy_outputs(pool, me, outputs);
        }
    }
    return troubled;
}

/* One value of each of count rows; four at a time, as there are many. */
static void take_column(const double *rows, size_t width, size_t count, double *column) {
    size_t j = 0;

    for (; j + 4 <= count; j += 4, rows += 4 * width) {
        column[j] = rows[0];
        column[j + 1] = rows[width];
        column[j + 2] = rows[2 * width];
        column[j + 3] = rows[3 * width];
    }
    for (; j < count; j++, rows += width) {
        column[j] = *rows;
    }
}

static void keep_outputs(const Task *task, size_t begin, size_t count, const double *outputs) {
    const Settings *s = &task->pool->settings;
    const size_t width = s->outputs->count;

    for (size_t i = 0; i < width; i++) {
        take_column(outputs + i, width, count, s->output_values + i * s->count + begin);
    }
}

WIDE static void convert(const double *values, size_t count, float *converted) {
    for (size_t i = 0; i < count; i++) {
        converted[i] = (float)values[i];
    }
}

static void write_observations(const Task *task, size_t begin, size_t count,
                               const double *outputs) {
    const size_t width = task->pool->settings.outputs->count;
    const size_t observed = task->pool->settings.num_observed;
    float *rows = task->call->observations + begin * observed;

    if (observed == width) {
        convert(outputs, count * width, rows);
        return;
    }
    for (size_t j = 0; j < count; j++) {
        convert(outputs + j * width, observed, rows + j * observed);
    }
}

/* The same scratch memory, without the first instances of its run. */
static Scratch scratch_from(const Pool *pool, Scratch scratch, size_t place) {
    scratch.inputs += place * pool->settings.inputs->count;
    scratch.outputs += place * pool->settings.outputs->count;
    return scratch;
}

/* Where a step has given no outputs, those from before are handed out. */
static size_t conclude_step(Task *task, size_t index, Status status, double *outputs) {
    if (status > STATUS_WARNING && status != STATUS_TERMINATED) {
        copy_outputs(task->pool, &task->pool->instances[index], outputs);
    }
    return note_status(task, index, status);
}

/* Resets an instance in the mask, or steps another; a plain step leaves those in the mask. */
static size_t do_one(Task *task, size_t index, Scratch scratch) {
    Pool *pool = task->pool;
    const Call *call = task->call;
    Instance *me = &pool->instances[index];
    size_t troubled = 0;

    if (!is_in(call->mask, index)) {
        return conclude_step(task, index, step_instance(pool, me, scratch), scratch.outputs);
    }
    if (task->operation != STEP) {
        if (call->turn != NULL) {
            play_draw(call->turn, index);
        }
        troubled = note_status(task, index, reset_instance(pool, me, call, scratch));
    }
    copy_outputs(pool, me, scratch.outputs);
    return troubled;
}

/* Those of a run that are stepped together, by one call of the FMI version, and the others; by their
 * places in the run. */
typedef struct {
    size_t count, others;
    uint32_t places[RUN], other_places[RUN];
    void *components[RUN];
    double times[RUN];
    Outcome outcomes[RUN];
} LineUp;

/* Takes the steps for done. Without branches: nobody can foresee which episodes have ended. */
static void line_up(const Task *task, size_t begin, size_t count, bool together, LineUp *line) {
    const Pool *pool = task->pool;
    const Library *library = pool->instances[begin].library;
    size_t steppers = 0, others = 0;

    for (size_t j = 0; j < count; j++) {
        Instance *me = &pool->instances[begin + j];
        const bool steps = together & !is_in(task->call->mask, begin + j) &
                           (me->phase == PHASE_STEPPING) & (me->library == library);

        line->places[steppers] = line->other_places[others] = (uint32_t)j;
        line->components[steppers] = me->component;
        line->times[steppers] = communication_point(pool, me);
        me->steps += steps;
        steppers += steps;
        others += !steps;
    }
    line->count = steppers;
    line->others = others;
}

/* Asks for the memory that a reset will read, if there is one: many places, far from each other. */
static void foresee_reset(const Task *task, size_t index) {
    const Call *call = task->call;
    const Matrix *values = &call->start_values;
    const char *place = values->data + (ptrdiff_t)index * values->column_stride;

    if (task->operation == STEP || !is_in(call->mask, index)) {
        return;
    }
    for (size_t i = 0; i < call->start->count; i++, place += values->row_stride) {
        prefetch(place);
    }
    if (call->turn != NULL) {
        play_foresee(call->turn->play, index);
    }
}

static Status status_of(Pool *pool, Instance *me, double time, Outcome outcome) {
    if (outcome.status <= STATUS_WARNING) {
        return outcome.status;
    }
    if (outcome.stage == SETTING_INPUTS) {
        me->steps--;
        return fail_setting(pool, me, outcome.status);
    }
    return outcome.stage == DOING_STEP ? fail_step(pool, me, time, outcome.status)
                                       : fail_reading(pool, me, outcome.status);
}

static size_t conclude_steps(Task *task, size_t begin, const LineUp *line, Scratch scratch) {
    Pool *pool = task->pool;
    size_t troubled = 0;

    for (size_t i = 0; i < line->count; i++) {
        const size_t place = line->places[i], index = begin + place;
        const Status status =
            status_of(pool, &pool->instances[index], line->times[i], line->outcomes[i]);
        double *outputs = scratch_from(pool, scratch, place).outputs;
        troubled += conclude_step(task, index, status, outputs);
    }
    return troubled;
}

static size_t step_together(Task *task, size_t begin, LineUp *line, Scratch scratch) {
    const Pool *pool = task->pool;
    const Access *in = pool->settings.inputs, *out = pool->settings.outputs;
    const Exchange e = {
        .input_references = in->groups[0].references,
        .output_references = out->groups[0].references,
        .number_of_inputs = in->count,
        .number_of_outputs = out->count,
        .step = pool->step_size,
        .no_return = pool->no_return,
        .count = line->count,
        .components = line->components,
        .places = line->places,
        .times = line->times,
        .floats = scratch.floats,
        .inputs = scratch.inputs,
        .outputs = scratch.outputs,
        .outcomes = line->outcomes,
    };
    if (!pool->settings.fmi->exchange(pool->instances[begin].library, &e)) {
        return conclude_steps(task, begin, line, scratch);
    }
    for (size_t i = 0; i < line->count; i++) {
        pool->settings.status[begin + line->places[i]] = STATUS_OK;
    }
    return 0;
}

static size_t do_each(Task *task, size_t begin, size_t count, Scratch scratch) {
    const Pool *pool = task->pool;
    LineUp line;
    size_t troubled = 0;

    line_up(task, begin, count, pool->direct && scratch.sound, &line);
    for (size_t i = 0; i < line.others; i++) {
        foresee_reset(task, begin + line.other_places[i]);
    }
    if (line.count > 0) {
        troubled += step_together(task, begin, &line, scratch);
    }
    for (size_t i = 0; i < line.others; i++) {
        const size_t place = line.other_places[i];
        troubled += do_one(task, begin + place, scratch_from(pool, scratch, place));
    }
    return troubled;
}

static size_t do_run(Task *task, size_t begin, size_t count, Scratch scratch) {
    gather_inputs(task, begin, count, scratch.inputs);
    scratch.sound = all_finite(scratch.inputs, count * task->pool->settings.inputs->count);
    size_t troubled = do_each(task, begin, count, scratch);

    if (!all_finite(scratch.outputs, count * task->pool->settings.outputs->count)) {
        troubled += take_not_finite(task, begin, count, scratch.outputs);
    }
    keep_outputs(task, begin, count, scratch.outputs);
    if (task->call->observations != NULL) {
        write_observations(task, begin, count, scratch.outputs);
    }
    return troubled;
}

static size_t length_of_run(size_t first, size_t end) {
    return end - first < RUN ? end - first : RUN;
}

static size_t step_through(Task *task, size_t begin, size_t end, Scratch scratch) {
    size_t troubled = 0;
    for (size_t first = begin; first < end; first += RUN) {
        troubled += do_run(task, first, length_of_run(first, end), scratch);
    }
    return troubled;
}

static size_t play_through(Task *task, size_t begin, size_t end, Scratch scratch) {
    const Turn *turn = task->call->turn;
    PlayScratch registers;
    size_t troubled = 0, ended = 0;

    play_open(turn, &registers);
    for (size_t first = begin; first < end; first += RUN) {
        const size_t count = length_of_run(first, end);
        play_prepare(turn, first, count, &registers);
        troubled += do_run(task, first, count, scratch);
        ended += play_judge(turn, first, count, &registers);
    }
    atomic_add(&task->ended, ended);
    return troubled;
}

/* Without 16 bytes per value nothing else will work either. The caller's arrays are filled all the
 * same: with what was there before. */
static size_t give_chunk_up(Task *task, size_t begin, size_t end) {
    const Call *call = task->call;

    for (size_t i = begin; i < end; i++) {
        const size_t index = task->listed ? task->pool->chosen[i] : i;
        refuse(&task->pool->instances[index], "out of memory");
        task->pool->settings.status[index] = STATUS_ERROR;
        if (call->observations != NULL) {
            write_observation(task->pool, index, call->observations);
        }
        if (call->turn != NULL) {
            play_skip(call->turn, index);
        }
    }
    return end - begin;
}

static size_t most_values(const Task *task) {
    const Settings *s = &task->pool->settings;
    const size_t in = s->inputs->count, out = s->outputs->count;
    const size_t start = task->call->start == NULL ? 0 : task->call->start->count;
    const size_t most = in > out ? in : out;
    return most > start ? most : start;
}

static size_t work_with(Task *task, size_t begin, size_t end, Scratch scratch) {
    if (task->listed) {
        return start_listed(task, begin, end, scratch);
    }
    return task->operation == PLAY ? play_through(task, begin, end, scratch)
                                   : step_through(task, begin, end, scratch);
}

static size_t work_with_memory(Task *task, size_t begin, size_t end) {
    const Settings *s = &task->pool->settings;
    const size_t most = most_values(task), run = task->listed ? 0 : length_of_run(begin, end);
    const size_t in = run * s->inputs->count, size = 2 * most + in + run * s->outputs->count;
    double stack[STACK_VALUES];
    double *memory = size <= STACK_VALUES ? stack : malloc(size * sizeof *memory);

    if (memory == NULL) {
        return give_chunk_up(task, begin, end);
    }
    const Floats floats = floats_now();
    const Scratch scratch = {memory, memory + most, memory + 2 * most, memory + 2 * most + in,
                             true, &floats};
    const size_t troubled = work_with(task, begin, end, scratch);
    if (memory != stack) {
        free(memory);
    }
    return troubled;
}

/* A chunk of the work, on any thread. */
static void work(void *context, size_t begin, size_t end) {
    Task *task = context;
    const uint64_t began = task->measured ? clock_now() : 0;

    begin_inside(task->pool);
    const size_t troubled = work_with_memory(task, begin, end);
    end_inside();
    if (troubled > 0) {
        atomic_add(&task->troubled, troubled);
    }
    if (task->measured) {
        atomic_add(&task->time, clock_now() - began);
    }
}

/* The first time an operation is done nothing is known of its cost: item by item, until there is
 * so much work that helpers are worth while. Returns how many items were done. */
static size_t explore(Task *task, Cost *cost, size_t count) {
    size_t done = 0;

    task->measured = true;
    while (done < count && (double)atomic_get(&task->time) < PARALLEL_FROM) {
        work(task, done, done + 1);
        done++;
    }
    cost->mean = (double)(atomic_get(&task->time) + 1) / (double)done;
    return done;
}

static size_t at_least_one(double items) {
    return items < 1.0 ? 1 : items > 1e9 ? (size_t)1e9 : (size_t)items;
}

/* Items from the first one on that explore has left. */
typedef struct {
    Task *task;
    size_t first;
} Rest;

static void work_on_rest(void *context, size_t begin, size_t end) {
    const Rest *rest = context;
    work(rest->task, rest->first + begin, rest->first + end);
}

static void run(Task *task, double mean, size_t first, size_t count) {
    const double total = mean * (double)(count - first);
    Rest rest = {task, first};
    const Job job = {
        .work = work_on_rest,
        .context = &rest,
        .count = count - first,
        .helpers = total < PARALLEL_FROM || task->call->alone ? 0 : task->pool->settings.threads - 1,
        .smallest = at_least_one(SMALLEST_CHUNK / mean),
        .largest = at_least_one(LARGEST_CHUNK / mean),
    };
    threads_run(&job);
}

static void run_measured(Task *task, Cost *cost, size_t count) {
    task->measured = count >= MANY || ++cost->calls % MEASURE_EVERY == 0;
    run(task, cost->mean, 0, count);
    if (task->measured) {
        const double mean = (double)atomic_get(&task->time) / (double)count;
        cost->mean += (mean - cost->mean) / 8.0;
    }
}

static size_t run_task(Task *task, size_t count) {
    Cost *cost = &task->pool->costs[task->operation];

    if (count == 0) {
        return 0;
    }
    if (cost->mean == 0.0) {
        const size_t done = explore(task, cost, count);
        if (done < count) {
            run(task, cost->mean, done, count);
        }
    } else {
        run_measured(task, cost, count);
    }
    return (size_t)atomic_get(&task->troubled);
}

bool pool_is_quick(const Pool *pool, int operation) {
    const double mean = pool->costs[operation].mean;
    return mean > 0.0 && mean * (double)pool->settings.count < QUICK;
}

/* Calls */

static size_t choose(Pool *pool, Mask mask) {
    const size_t count = pool->settings.count;
    size_t chosen = 0;

    for (size_t i = 0; i < count; i++) {
        pool->chosen[chosen] = (uint32_t)i;
        chosen += mask.data == NULL || mask.data[(ptrdiff_t)i * mask.stride] != 0;
    }
    return chosen;
}

/* Other start variables than before: what was kept of them is of no use any more. */
static bool make_room_for_starts(Pool *pool, const Access *start) {
    const size_t count = pool->settings.count;

    if (start->count <= pool->start_width) {
        return true;
    }
    double *starts = malloc(count * start->count * sizeof *starts);
    if (starts == NULL) {
        return false;
    }
    free(pool->starts);
    pool->starts = starts;
    pool->start_width = start->count;
    for (size_t i = 0; i < count; i++) {
        pool->instances[i].start_id = 0;
    }
    return true;
}

/* The new start values may need more room than there is. */
static size_t run_with_starts(Task *task, size_t count) {
    return make_room_for_starts(task->pool, task->call->start) ? run_task(task, count)
                                                               : give_chunk_up(task, 0, count);
}

size_t pool_step(Pool *pool, const Call *call) {
    Task task = {.pool = pool, .call = call, .operation = STEP};
    return run_task(&task, pool->settings.count);
}

size_t pool_reset(Pool *pool, const Call *call) {
    Task task = {.pool = pool, .call = call, .operation = RESET, .listed = true};
    return run_with_starts(&task, choose(pool, call->mask));
}

size_t pool_step_or_reset(Pool *pool, const Call *call) {
    Task task = {.pool = pool, .call = call, .operation = MIXED};
    return run_with_starts(&task, pool->settings.count);
}

size_t pool_play(Pool *pool, const Call *call, size_t *ended) {
    Task task = {.pool = pool, .call = call, .operation = PLAY};
    const size_t troubled = run_with_starts(&task, pool->settings.count);

    *ended = (size_t)atomic_get(&task.ended);
    return troubled;
}

/* Reads variables of one instance to a column of values. */
static Status read_instance(Pool *pool, Instance *me, const Access *access, double *memory,
                            double *column) {
    if (me->phase != PHASE_STEPPING && me->phase != PHASE_ENDED) {
        return refuse(me, "nothing can be read before a reset has mended the instance");
    }
    const Status status =
        access_get(access, me->library, me->component, memory, memory + access->count);
    if (status > STATUS_WARNING) {
        return fail(pool, me, "reading variables", status);
    }
    for (size_t i = 0; i < access->count; i++) {
        column[i * pool->settings.count] = memory[i];
    }
    return status;
}

ptrdiff_t pool_read(Pool *pool, const Access *access, double *values) {
    double *memory = malloc((2 * access->count + 1) * sizeof *memory);
    ptrdiff_t failed = -1;

    if (memory == NULL) {
        refuse(&pool->instances[0], "out of memory");
        return 0;
    }
    for (size_t i = 0; i < pool->settings.count && failed < 0; i++) {
        Instance *me = &pool->instances[i];
        if (read_instance(pool, me, access, memory, values + i) > STATUS_WARNING) {
            failed = (ptrdiff_t)i;
        }
    }
    free(memory);
    return failed;
}

bool pool_failure(Pool *pool, size_t index, Failure *copy) {
    const Failure *failure = pool->instances[index].failure;

    if (failure != NULL) {
        *copy = *failure;
        copy->said = copy_text(failure->said);
        copy->values = copy_values(failure->values, failure->number_of_values);
    }
    return failure != NULL;
}

void pool_count_steps(Pool *pool) {
    for (size_t i = 0; i < pool->settings.count; i++) {
        count_steps(pool, &pool->instances[i]);
    }
}

void pool_recycle(Pool *pool) {
    for (size_t i = 0; i < pool->settings.count; i++) {
        pool->instances[i].due = true;
    }
}

/* Snapshots */

Snapshot *snapshot_new(size_t count) {
    Snapshot *snapshot = calloc(1, sizeof *snapshot);

    if (snapshot == NULL) {
        return NULL;
    }
    snapshot->states = calloc(count, sizeof *snapshot->states);
    snapshot->steps = calloc(count, sizeof *snapshot->steps);
    snapshot->generations = calloc(count, sizeof *snapshot->generations);
    if (snapshot->states == NULL || snapshot->steps == NULL || snapshot->generations == NULL) {
        snapshot_free(snapshot);
        return NULL;
    }
    return snapshot;
}

void snapshot_free(Snapshot *snapshot) {
    free(snapshot->states);
    free(snapshot->steps);
    free(snapshot->generations);
    free(snapshot);
}

static bool is_own(const Pool *pool, const Snapshot *snapshot, size_t index) {
    return snapshot->states[index] != NULL &&
           snapshot->generations[index] == pool->instances[index].generation;
}

static void unlink_snapshot(Pool *pool, const Snapshot *snapshot) {
    for (Snapshot **link = &pool->snapshots; *link != NULL; link = &(*link)->next) {
        if (*link == snapshot) {
            *link = snapshot->next;
            return;
        }
    }
}

/* The states of a closed pool went with its instances. */
static void drop_snapshot(Pool *pool, Snapshot *snapshot) {
    unlink_snapshot(pool, snapshot);
    for (size_t i = 0; i < pool->settings.count && pool->open; i++) {
        if (is_own(pool, snapshot, i)) {
            free_state(pool, &pool->instances[i], &snapshot->states[i]);
        }
    }
    snapshot_free(snapshot);
}

static void drop_abandoned(Pool *pool) {
    if (!atomic_get(&pool->abandoned)) {
        return;
    }
    atomic_set(&pool->abandoned, 0); /* before the look at the snapshots: no later one is missed */
    for (Snapshot *snapshot = pool->snapshots, *next; snapshot != NULL; snapshot = next) {
        next = snapshot->next;
        if (atomic_get(&snapshot->abandoned)) {
            drop_snapshot(pool, snapshot);
        }
    }
}

/* Who is inside may have looked for abandoned ones just before: so a second try. After that, the next
 * one inside finds it. */
void pool_abandon(Pool *pool, Snapshot *snapshot) {
    atomic_set(&snapshot->abandoned, 1);
    atomic_set(&pool->abandoned, 1);
    if (mutex_try_lock(&pool->lock)) {
        begin_inside(pool);
        pool_leave(pool);
    }
}

static Status save_instance(Pool *pool, Instance *me, Snapshot *snapshot) {
    const size_t index = index_of(pool, me);

    if (me->phase != PHASE_STEPPING) {
        return refuse(me, me->phase == PHASE_INSTANTIATED
                              ? "cannot save the FMU state before the first reset"
                              : "cannot save the FMU state before a reset has mended the instance");
    }
    snapshot->generations[index] = me->generation;
    snapshot->steps[index] = me->steps;
    return save_state(pool, me, &snapshot->states[index]);
}

ptrdiff_t pool_save(Pool *pool, Snapshot *snapshot) {
    pool->no_return = false;
    snapshot->next = pool->snapshots;
    pool->snapshots = snapshot;
    for (size_t i = 0; i < pool->settings.count; i++) {
        if (save_instance(pool, &pool->instances[i], snapshot) > STATUS_WARNING) {
            drop_snapshot(pool, snapshot);
            return (ptrdiff_t)i;
        }
    }
    return -1;
}

bool pool_restore(Pool *pool, const Snapshot *snapshot, Mask mask, size_t *troubled) {
    const Call call = {.mask = mask};
    Task task = {.pool = pool, .call = &call, .operation = RESTORE, .snapshot = snapshot};

    for (size_t i = 0; i < pool->settings.count; i++) {
        if ((mask.data == NULL || is_in(mask, i)) && !is_own(pool, snapshot, i)) {
            return false;
        }
    }
    task.listed = true;
    *troubled = run_task(&task, choose(pool, mask));
    return true;
}

/* Opening and closing */

static Mutex list_lock = MUTEX_INITIALIZER;
static Pool *pools;

static void link_pool(Pool *pool) {
    mutex_lock(&list_lock);
    pool->next = pools;
    pools = pool;
    mutex_unlock(&list_lock);
}

static void unlink_pool(const Pool *pool) {
    mutex_lock(&list_lock);
    for (Pool **link = &pools; *link != NULL; link = &(*link)->next) {
        if (*link == pool) {
            *link = pool->next;
            break;
        }
    }
    mutex_unlock(&list_lock);
}

static size_t number_of_libraries(const Settings *s) {
    return s->private_libraries ? s->count : 1;
}

static bool allocate(Pool *pool) {
    const Settings *s = &pool->settings;

    pool->name_size = strlen(s->model) + sizeof "_4294967295_4294967295";
    pool->libraries = calloc(number_of_libraries(s), sizeof *pool->libraries);
    pool->instances = calloc(s->count, sizeof *pool->instances);
    pool->names = calloc(s->count, pool->name_size);
    pool->chosen = calloc(s->count + 1, sizeof *pool->chosen);
    pool->starts = calloc(1, sizeof *pool->starts); /* of no width yet */
    return pool->libraries != NULL && pool->instances != NULL && pool->names != NULL &&
           pool->chosen != NULL && pool->starts != NULL;
}

static void prepare_instance(Pool *pool, size_t index) {
    const Settings *s = &pool->settings;
    Instance *me = &pool->instances[index];

    snprintf(pool->names + index * pool->name_size, pool->name_size, "%s_%u_%zu", s->model,
             (unsigned)pool->log.id, index);
    me->library = &pool->libraries[s->private_libraries ? index : 0];
}

static bool load_libraries(Pool *pool, char *error, size_t size) {
    const Settings *s = &pool->settings;
    const Floats floats = floats_now();
    bool loaded = true;

    for (size_t i = 0; i < number_of_libraries(s) && loaded; i++) {
        pool->libraries[i].identifier = s->model;
        loaded = library_open(&pool->libraries[i], s->paths[i], error, size) &&
                 s->fmi->bind(&pool->libraries[i], error, size);
    }
    floats_restore(&floats);
    return loaded;
}

static bool build_all(Pool *pool, char *error, size_t size) {
    for (size_t i = 0; i < pool->settings.count; i++) {
        if (!build(pool, &pool->instances[i])) {
            char *said = log_said(&pool->log, i);
            snprintf(error, size, "it refused to be instantiated%s%s",
                     said == NULL ? "" : "; the FMU said: ", said == NULL ? "" : said);
            free(said);
            return false;
        }
    }
    return true;
}

bool pool_open(Pool *pool, const Settings *settings, char *error, size_t size) {
    memset(pool, 0, sizeof *pool);
    mutex_reset(&pool->lock);
    mutex_reset(&pool->making);
    pool->settings = *settings;
    pool->step_size = settings->time_step / (double)settings->substeps;
    pool->no_return = !settings->restores && settings->retries == 0;
    pool->direct = settings->substeps == 1 && settings->retries == 0 && settings->inputs->direct &&
                   settings->outputs->direct;
    pool->open = true;
    link_pool(pool);
    snprintf(error, size, "out of memory");
    if (!log_open(&pool->log, settings->count) || !allocate(pool)) {
        return false;
    }
    for (size_t i = 0; i < settings->count; i++) {
        prepare_instance(pool, i);
    }
    return load_libraries(pool, error, size) && build_all(pool, error, size);
}

/* As many as were made before memory ran out. */
static void free_instances(Pool *pool) {
    const Settings *s = &pool->settings;
    const Floats floats = floats_now();

    for (size_t i = 0; i < s->count && pool->instances != NULL; i++) {
        discard(pool, &pool->instances[i]);
        drop_failure(&pool->instances[i]);
    }
    for (size_t i = 0; i < number_of_libraries(s) && pool->libraries != NULL; i++) {
        library_close(&pool->libraries[i]);
    }
    floats_restore(&floats);
}

void pool_close(Pool *pool) {
    drop_abandoned(pool);
    free_instances(pool);
    pool->open = false;
    free(pool->libraries);
    free(pool->instances);
    free(pool->starts);
    free(pool->names);
    free(pool->chosen);
    unlink_pool(pool);
}

void pool_dispose(Pool *pool) {
    while (pool->snapshots != NULL) {
        drop_snapshot(pool, pool->snapshots);
    }
    mutex_destroy(&pool->lock);
    mutex_destroy(&pool->making);
}

/* Entering */

static Entry enter_locked(Pool *pool) {
    if (!pool->open) {
        mutex_unlock(&pool->lock);
        return ENTRY_CLOSED;
    }
    begin_inside(pool);
    return ENTRY_ENTERED;
}

Entry pool_try_enter(Pool *pool) {
    if (is_inside(pool)) {
        return ENTRY_INSIDE;
    }
    return mutex_try_lock(&pool->lock) ? enter_locked(pool) : ENTRY_BUSY;
}

Entry pool_enter(Pool *pool) {
    if (is_inside(pool)) {
        return ENTRY_INSIDE;
    }
    mutex_lock(&pool->lock);
    return enter_locked(pool);
}

void pool_leave(Pool *pool) {
    drop_abandoned(pool);
    end_inside();
    mutex_unlock(&pool->lock);
}

/* Fork: only the forking thread lives on in the child, so what others had locked is free there. */

#if !defined _WIN32

static void before_fork(void) {
    mutex_lock(&list_lock);
    log_before_fork();
}

static void after_fork_in_parent(void) {
    log_after_fork_in_parent();
    mutex_unlock(&list_lock);
}

static void after_fork_in_child(void) {
    log_after_fork_in_child();
    mutex_reset(&list_lock);
    threads_reset();
    for (Pool *pool = pools; pool != NULL; pool = pool->next) {
        mutex_reset(&pool->lock);
        mutex_reset(&pool->making);
    }
}

#endif

void pool_prepare_process(void) {
    threads_reset();
#if !defined _WIN32
    pthread_atfork(before_fork, after_fork_in_parent, after_fork_in_child);
#endif
}
