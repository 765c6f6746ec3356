/* The division of a call's work among threads. */

#include "pool/schedule.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "pool/inside.h"
#include "pool/play.h"
#include "pool/runs.h"
#include "pool/threads.h"

/* All in ns. */
static const double QUICK = 10e3; /* calls this short may block other threads */
static const double SMALLEST_CHUNK = 2e3;
static const double LARGEST_CHUNK = 50e3;
static const double WORTH_A_THREAD = 10e3; /* amount of work that justifies waking another thread */
static const double LASTING = 1e6; /* an item this long is not for one thread after another */

enum {
    STACK_VALUES = 8192,
    MANY = 64,         /* with this many instances or more, every call is measured */
    MEASURE_EVERY = 16 /* with fewer instances, one call in this many is measured */
};

size_t task_give_up(Task *task, size_t begin, size_t end) {
    const Call *call = task->call;

    for (size_t i = begin; i < end; i++) {
        const size_t index = task->listed ? task->pool->chosen[i] : i;
        instance_refuse(&task->pool->instances[index], "out of memory");
        task->pool->settings.status[index] = STATUS_ERROR;
        if (task->operation == PLAY || task->operation == AFTER) {
            play_skip(call->turn, index);
        }
        if (call->observations != NULL) {
            write_observation(task->pool, index, call->observations);
        }
    }
    return end - begin;
}

static size_t most_values(const Task *task) {
    const Settings *s = &task->pool->settings;
    const size_t in = s->inputs->width, out = s->outputs->width;
    const size_t start = task->call->start == NULL ? 0 : task->call->start->width;
    const size_t most = in > out ? in : out;
    return most > start ? most : start;
}

static size_t work_with(Task *task, size_t begin, size_t end, Scratch scratch) {
    if (task->listed) {
        return run_listed(task, begin, end, scratch);
    }
    return task->operation == PLAY || task->operation == AFTER
               ? run_play(task, begin, end, scratch)
               : run_steps(task, begin, end, scratch);
}

static size_t work_with_memory(Task *task, size_t begin, size_t end) {
    const Settings *s = &task->pool->settings;
    const size_t most = most_values(task), run = task->listed ? 0 : length_of_run(begin, end);
    const size_t in = run * s->inputs->count, out = run * s->outputs->count;
    const size_t size = 2 * most + in + out;
    double stack[STACK_VALUES];
    double *memory = size <= STACK_VALUES ? stack : malloc(size * sizeof *memory);

    if (memory == NULL) {
        return task_give_up(task, begin, end);
    }
    double *inputs = memory + 2 * most;
    const Scratch scratch = {memory, memory + most, inputs, inputs + in, true};
    const size_t troubled = work_with(task, begin, end, scratch);
    if (memory != stack) {
        free(memory);
    }
    return troubled;
}

/* Works on a chunk, on a thread that is inside the pool. */
static void work(Task *task, size_t begin, size_t end) {
    const uint64_t began = task->measured ? clock_now() : 0;
    const size_t troubled = task->operation == BEFORE ? run_before(task, begin, end)
                                                      : work_with_memory(task, begin, end);

    if (troubled > 0) {
        atomic_add(&task->troubled, troubled);
    }
    if (task->measured) {
        atomic_add(&task->time, clock_now() - began);
    }
}

/* The second smallest of the last samples, or the smallest while there are few. */
static double low_quantile(const Cost *cost) {
    const size_t count = cost->taken < SAMPLES ? cost->taken : SAMPLES;
    double first = cost->samples[0], second = INFINITY;

    for (size_t i = 1; i < count; i++) {
        const double sample = cost->samples[i];
        second = sample < first ? first : sample < second ? sample : second;
        first = sample < first ? sample : first;
    }
    return count < SAMPLES ? first : second;
}

static void add_sample(Cost *cost, double sample) {
    cost->samples[cost->taken++ % SAMPLES] = sample;
    cost->low = low_quantile(cost);
}

/* The cost of an operation is unknown the first time. So this works item by item until there is
 * enough work to justify helpers. Returns how many items were done. */
static size_t explore(Task *task, Cost *cost, size_t count) {
    size_t done = 0;

    task->measured = true;
    while (done < count && (double)atomic_get(&task->time) < 2.0 * WORTH_A_THREAD) {
        work(task, done, done + 1);
        done++;
    }
    add_sample(cost, (double)(atomic_get(&task->time) + 1) / (double)done);
    return done;
}

static size_t at_least_one(double items) {
    return items < 1.0 ? 1 : items > 1e9 ? (size_t)1e9 : (size_t)items;
}

/* The items that explore has left, beginning with first. */
typedef struct {
    Task *task;
    size_t first;
} Rest;

/* Any thread may do this. Only the caller's is inside the pool already. */
static void work_on_rest(void *context, size_t begin, size_t end) {
    const Rest *rest = context;
    Pool *pool = rest->task->pool;

    begin_inside(pool);
    work(rest->task, rest->first + begin, rest->first + end);
    floats_restore(&pool->floats);
    end_inside();
}

/* The number of threads worth waking in addition to the caller's. */
static size_t number_of_helpers(const Task *task, double total) {
    const size_t most = task->pool->settings.threads - 1;
    const size_t wanted = at_least_one(total / WORTH_A_THREAD) - 1;

    return task->call->alone ? 0 : wanted < most ? wanted : most;
}

/* While others work, the caller's thread looks whether they are to end. */
static void look(void) {
    (void)is_interrupted();
}

static void run(Task *task, double cost, size_t first, size_t count) {
    if (count - first == 1) { /* there is nothing to divide */
        work(task, first, count);
        return;
    }
    Rest rest = {task, first};
    const Job job = {
        .work = work_on_rest,
        .context = &rest,
        .count = count - first,
        .helpers = number_of_helpers(task, cost * (double)(count - first)),
        .smallest = at_least_one(SMALLEST_CHUNK / cost),
        .largest = at_least_one(LARGEST_CHUNK / cost),
        .lasting = cost >= LASTING,
        .look = look,
    };
    threads_run(&job);
}

static void run_measured(Task *task, Cost *cost, size_t count) {
    task->measured = count >= MANY || ++cost->calls % MEASURE_EVERY == 0;
    run(task, cost->low, 0, count);
    if (task->measured) {
        add_sample(cost, (double)(atomic_get(&task->time) + 1) / (double)count);
    }
}

size_t schedule_run(Task *task, size_t count) {
    Cost *cost = &task->pool->costs[task->operation];

    if (count == 0) {
        return 0;
    }
    if (cost->taken == 0) {
        const size_t done = explore(task, cost, count);
        if (done < count) {
            run(task, cost->low, done, count);
        }
    } else {
        run_measured(task, cost, count);
    }
    return (size_t)atomic_get(&task->troubled);
}

bool pool_is_quick(const Pool *pool, int operation) {
    const Cost *cost = &pool->costs[operation];
    return cost->taken > 0 && cost->low * (double)pool->settings.count < QUICK;
}

size_t schedule_choose(Pool *pool, Mask mask) {
    const size_t count = pool->settings.count;
    size_t chosen = 0;

    for (size_t i = 0; i < count; i++) {
        pool->chosen[chosen] = (uint32_t)i;
        chosen += mask.data == NULL || mask.data[(ptrdiff_t)i * mask.stride] != 0;
    }
    return chosen;
}

/* Makes room for wider rows of start values. The values kept so far no longer apply. */
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
    memset(pool->start_ids, 0, count * sizeof *pool->start_ids);
    return true;
}

size_t schedule_run_with_starts(Task *task, size_t count) {
    return make_room_for_starts(task->pool, task->call->start) ? schedule_run(task, count)
                                                               : task_give_up(task, 0, count);
}
