#include "update.h"

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "access.h"
#include "platform.h"
#include "pool.h"
#include "solver.h"

/* What is collected of one output between the beginning of a substep and its latest point. */
typedef struct {
    double last, low, high;
    double area; /* below straight lines through the points; before the first one its value holds */
} Course;

struct Updates {
    struct Updates *outer; /* of the FMU around whose step this thread does this one */
    Solver *solver;
    double begin, end; /* of the FMU's step */
    double least;      /* no later update of this step may be before this time */
    bool asked;        /* whether the FMU has asked for inputs in this step */
    bool strayed;      /* whether it has made an update for another instance */
    bool busy;         /* whether an update is being answered */
    Status status;     /* the worst of this step */
    bool collects;     /* whether any step has begun since updates_clear */
    size_t points;
    double first, last; /* the times at which the substep begins, and of its latest point */
    double *values, *typed;
    Course *courses;
};

/* The step that this thread does. */
static THREAD_LOCAL Updates *current;

/* Environments of FMUs that called back from outside of their step. Two of them may have one place: then
 * one goes unnoticed. */
enum { STRAYS = 64 };
static Atomic strays[STRAYS];

static Atomic *stray_of(uint64_t environment) {
    return &strays[(environment ^ environment >> 32) % STRAYS];
}

/* Memory */

static size_t number_of_watched(const Solving *s) {
    return s->watched == NULL ? 0 : s->watched->count;
}

static void add_references(uint32_t *references, size_t *count, const uint32_t *more, size_t n) {
    for (size_t i = 0; i < n; i++) {
        bool known = false;
        for (size_t j = 0; j < *count; j++) {
            known |= references[j] == more[i];
        }
        if (!known) {
            references[(*count)++] = more[i];
        }
    }
}

uint32_t *updates_references(const Solving *s, size_t *count) {
    const size_t most = s->number_of_ramps + number_of_watched(s);
    uint32_t *references = most == 0 ? NULL : malloc(most * sizeof *references);

    *count = 0;
    if (references == NULL) {
        return NULL;
    }
    add_references(references, count, s->ramped_references, s->number_of_ramps);
    for (size_t i = 0; s->watched != NULL && i < s->watched->number_of_groups; i++) {
        const Group *group = &s->watched->groups[i];
        add_references(references, count, group->references, group->count);
    }
    return references;
}

Updates *updates_open(Solver *solver) {
    const Solving *s = solver->solving;
    const size_t count = number_of_watched(s);
    const size_t width = s->watched == NULL ? 0 : s->watched->width;
    Updates *me = calloc(1, sizeof *me);

    if (me == NULL) {
        return NULL;
    }
    me->solver = solver;
    me->values = calloc(count + 1, sizeof *me->values);
    me->typed = calloc(width + 1, sizeof *me->typed);
    me->courses = calloc(count + 1, sizeof *me->courses);
    if (me->values == NULL || me->typed == NULL || me->courses == NULL) {
        updates_close(me);
        return NULL;
    }
    return me;
}

void updates_close(Updates *me) {
    if (me != NULL) {
        free(me->values);
        free(me->typed);
        free(me->courses);
        free(me);
    }
}

/* Outputs */

void updates_clear(Updates *me) {
    me->collects = false;
    me->points = 0;
}

void updates_begin(void *component) {
    updates_clear(((Solver *)component)->updates);
}

static void extend(Course *course, double duration, bool is_first, double value) {
    if (is_first) {
        *course = (Course){value, value, value, duration * value};
        return;
    }
    course->area += duration * (0.5 * (course->last + value));
    course->low = course->low <= value ? course->low : value;
    course->high = course->high >= value ? course->high : value;
    course->last = value;
}

/* Adds the outputs at a time that is not before the latest point. */
static void add_point(Updates *me, double time, size_t output, double value) {
    const bool is_first = me->points == 0;
    extend(&me->courses[output], time - (is_first ? me->first : me->last), is_first, value);
}

static Status collect(Updates *me, double time) {
    const Solver *solver = me->solver;
    const Access *watched = solver->solving->watched;
    const Status status = access_get(watched, solver->library, (void *)solver, me->values,
                                     me->typed, solver->floats);

    if (good(status)) {
        for (size_t i = 0; i < watched->count; i++) {
            add_point(me, time, i, me->values[i]);
        }
        me->last = time;
        me->points++;
    }
    return status;
}

static double result_of(const Course *course, unsigned char sampling, double duration) {
    switch (sampling) {
    case SAMPLE_MIN:
        return course->low;
    case SAMPLE_MAX:
        return course->high;
    default:
        return duration > 0.0 ? course->area / duration : course->last;
    }
}

void updates_summarize(void *component, const unsigned char *sampling, double *outputs) {
    Updates *me = ((Solver *)component)->updates;
    const Solving *s = me->solver->solving;

    for (size_t i = 0; me->points > 0 && i < s->watched->count; i++) {
        double *output = &outputs[s->watched_places[i]];
        add_point(me, me->end, i, *output);
        *output = result_of(&me->courses[i], sampling[s->watched_places[i]], me->end - me->first);
    }
    updates_clear(me);
}

/* Updates */

static double resolution(const Updates *me) {
    const double begin = fabs(me->begin), end = fabs(me->end);
    return 16.0 * DBL_EPSILON * (begin > end ? begin : end);
}

/* The time of an update between the beginning and the end of the step, but for roundings. */
static Status check_time(const Updates *me, double *time) {
    const double rounding = resolution(me);

    if (!(*time >= me->begin - rounding && *time <= me->end + rounding)) {
        return solver_fail(me->solver,
                           "the FMU made an intermediate update at t = %.17g s in a step from "
                           "t = %.17g s to %.17g s",
                           *time, me->begin, me->end);
    }
    if (*time < me->least - rounding) {
        return solver_fail(me->solver,
                           "the FMU made an intermediate update at t = %.17g s after it had "
                           "finished a step to t = %.17g s",
                           *time, me->least);
    }
    *time = *time < me->least ? me->least : *time;
    *time = *time > me->end ? me->end : *time;
    return STATUS_OK;
}

/* FMI allows no Discard here; nothing could be tried again. */
static Status judge(const Updates *me, const char *doing, double time, Status status) {
    if (good(status)) {
        return status;
    }
    solver_fail(me->solver, "the FMU failed at %s in its intermediate update at t = %.17g s", doing,
                time);
    return status == STATUS_FATAL ? status : STATUS_ERROR;
}

static Status answer(Updates *me, double time, bool set_requested, bool get_allowed,
                     bool finished) {
    const Solving *s = me->solver->solving;
    Status status = check_time(me, &time);

    if (good(status) && set_requested && s->number_of_ramps > 0) {
        me->asked = true;
        status = judge(me, "setting inputs", time, ramps_set(me->solver, time));
    }
    if (good(status) && get_allowed && finished && s->watched != NULL) {
        status = judge(me, "reading outputs", time, collect(me, time));
    }
    me->least = finished && good(status) ? time : me->least;
    return status;
}

/* An FMU may call this without asking whether it is there. Nobody wants an early return. */
void updates_answer(void *environment, double time, bool set_requested, bool get_allowed,
                    bool step_finished, bool can_return_early, bool *early_return_requested,
                    double *early_return_time) {
    const uint64_t number = (uint64_t)(uintptr_t)environment;
    Updates *me = current;

    (void)can_return_early;
    if (early_return_requested != NULL) {
        *early_return_requested = false;
    }
    if (early_return_time != NULL) {
        *early_return_time = time;
    }
    if (me == NULL) {
        atomic_set(stray_of(number), number);
        return;
    }
    if (me->solver->environment != number) {
        me->strayed = true;
        return;
    }
    if (me->busy || !good(me->status)) {
        return;
    }
    const Floats floats = floats_now(); /* those of the FMU */
    floats_restore(me->solver->floats);
    me->busy = true;
    me->status = answer(me, time, set_requested, get_allowed, step_finished);
    me->busy = false;
    floats_restore(&floats);
}

/* Steps */

static void begin(Updates *me, double time, double size) {
    uint64_t own = me->solver->environment;

    atomic_replace(stray_of(own), &own, 0);
    me->begin = me->least = time;
    me->end = time + size;
    me->asked = me->strayed = false;
    me->status = STATUS_OK;
    if (!me->collects) {
        me->collects = true;
        me->first = time;
    }
    me->outer = current;
    current = me;
}

static bool has_strayed(const Updates *me) {
    uint64_t own = me->solver->environment;
    return atomic_replace(stray_of(own), &own, 0) || me->strayed;
}

/* The worse of both statuses. */
static Status finish(Updates *me, Status status) {
    current = me->outer;
    if (has_strayed(me) && good(me->status)) {
        me->status = solver_fail(me->solver,
                                 "the FMU made an intermediate update in another thread, or for "
                                 "another instance, in its step from t = %.17g s",
                                 me->begin);
    }
    if (good(status) && good(me->status) && !me->asked && ramps_move(me->solver)) {
        me->status = solver_fail(me->solver,
                                 "the FMU asked for no inputs in its step from t = %.17g s to "
                                 "%.17g s, so that none can be linear",
                                 me->begin, me->end);
    }
    return status == STATUS_FATAL || good(me->status) ? status : me->status;
}

Status updates_step(Solver *solver, double time, double size, double *reached, bool *event,
                    bool *terminate) {
    Updates *me = solver->updates;

    if (me == NULL) {
        return solver->model->step(solver->library, solver->component, time, size, reached, event,
                                   terminate);
    }
    begin(me, time, size);
    const Status status = solver->model->step(solver->library, solver->component, time, size,
                                              reached, event, terminate);
    solver_restore_floats(solver);
    return finish(me, status);
}
