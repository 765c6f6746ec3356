/* Opening and closing pools, and forks. */

#include "pool/pool.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "pool/copies.h"
#include "pool/failures.h"
#include "pool/inside.h"
#include "pool/instances.h"
#include "pool/loading.h"
#include "pool/recorded_inputs.h"
#include "pool/snapshots.h"
#include "pool/threads.h"

static Mutex list_lock = MUTEX_INITIALIZER;
static Mutex shared_making = MUTEX_INITIALIZER; /* of all pools with one_initialization */
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

/* The memory is one cache line longer than needed, so the start can move to the next line. */
static void *at_cache_line(void *memory) {
    const uintptr_t rest = (uintptr_t)memory % CACHE_LINE;
    return memory == NULL || rest == 0 ? memory : (char *)memory + (CACHE_LINE - rest);
}

static bool allocate(Pool *pool) {
    const Settings *s = &pool->settings;

    pool->libraries = calloc(number_of_libraries(s), sizeof *pool->libraries);
    pool->instance_memory = calloc(s->count + 1, sizeof *pool->instances);
    pool->instances = at_cache_line(pool->instance_memory);
    pool->names = calloc(s->count, LOG_NAME);
    pool->chosen = calloc(s->count + 1, sizeof *pool->chosen);
    pool->starts = calloc(1, sizeof *pool->starts); /* the width is still 0 */
    pool->start_ids = calloc(s->count, sizeof *pool->start_ids);
    pool->first_outputs = calloc(s->restores ? s->count * s->outputs->count + 1 : 1,
                                 sizeof *pool->first_outputs);
    return pool->libraries != NULL && pool->instances != NULL && pool->names != NULL &&
           pool->chosen != NULL && pool->starts != NULL && pool->start_ids != NULL &&
           pool->first_outputs != NULL && (!s->records || records_open(pool));
}

static void prepare_instance(Pool *pool, size_t index) {
    const Settings *s = &pool->settings;
    Instance *me = &pool->instances[index];

    log_name(pool->names + index * LOG_NAME, s->model, log_environment(&pool->log, index));
    me->library = &pool->libraries[s->private_libraries ? index : 0];
    me->start_time = s->experiment.start_time;
}

static bool load_libraries(Pool *pool, char *error, size_t size) {
    const Settings *s = &pool->settings;
    bool loaded = true;

    for (size_t i = 0; i < number_of_libraries(s) && loaded; i++) {
        loaded = pool_load(pool, i, error, size);
    }
    floats_restore(&pool->floats);
    return loaded;
}

/* Appends what the FMU said. If that is too long, only its end is kept. */
static void explain_refusal(Pool *pool, size_t index, char *error, size_t size) {
    char *said = log_said(&pool->log, index);
    char number[64] = "";

    if (index > 0) {
        snprintf(number, sizeof number, " as number %zu of %zu", index + 1, pool->settings.count);
    }
    const size_t length =
        (size_t)snprintf(error, size, "it refused to be instantiated%s" LOG_SAID, number);
    const size_t said_length = said == NULL ? 0 : strlen(said);
    const size_t room = size - 1 - length;

    if (said != NULL) {
        strcpy(error + length, said + (said_length > room ? said_length - room : 0));
    }
    free(said);
}

static bool build_all(Pool *pool, char *error, size_t size) {
    for (size_t i = 0; i < pool->settings.count; i++) {
        if (!instance_build(pool, &pool->instances[i])) {
            explain_refusal(pool, i, error, size);
            return false;
        }
    }
    return true;
}

static bool open_inside(Pool *pool, const Settings *settings, char *error, size_t size) {
    memset(pool, 0, sizeof *pool);
    mutex_reset(&pool->lock);
    mutex_reset(&pool->own_making);
    pool->making = settings->one_initialization ? &shared_making : &pool->own_making;
    pool->settings = *settings;
    pool->step_size = settings->time_step / (double)settings->substeps;
    pool->no_return = !settings->restores && !settings->returns && settings->retries == 0;
    pool->direct = settings->substeps == 1 && settings->retries == 0 &&
                   settings->sampling == NULL &&
                   (settings->inputs->count == 0 || access_is_plain(settings->inputs)) &&
                   access_is_plain(settings->outputs);
    pool->open = true;
    pool->floats = floats_now();
    link_pool(pool);
    snprintf(error, size, "out of memory");
    if (!log_open(&pool->log, settings->count, parts_of(settings), !settings->logging) ||
        !allocate(pool)) {
        return false;
    }
    for (size_t i = 0; i < settings->count; i++) {
        prepare_instance(pool, i);
    }
    return settings->elsewhere ||
           (load_libraries(pool, error, size) && build_all(pool, error, size));
}

bool pool_open(Pool *pool, const Settings *settings, char *error, size_t size) {
    begin_inside(pool);
    const bool opened = open_inside(pool, settings, error, size);
    end_inside();
    return opened;
}

/* Frees the instances that exist. Memory may have run out before all were made. */
static void free_instances(Pool *pool) {
    const Settings *s = &pool->settings;

    for (size_t i = 0; i < s->count && pool->instances != NULL; i++) {
        instance_discard(pool, &pool->instances[i]);
        failure_drop(&pool->instances[i]);
    }
    copies_close(pool);
    for (size_t i = 0; i < number_of_libraries(s) && pool->libraries != NULL; i++) {
        pool_unload(pool, i);
    }
    floats_restore(&pool->floats);
}

void pool_close(Pool *pool) {
    snapshots_drop_all(pool);
    free_instances(pool);
    pool->open = false;
    free(pool->libraries);
    free(pool->instance_memory);
    free(pool->starts);
    free(pool->start_ids);
    free(pool->first_outputs);
    free(pool->names);
    free(pool->chosen);
    records_close(pool);
    unlink_pool(pool);
}

void pool_dispose(Pool *pool) {
    mutex_destroy(&pool->lock);
    mutex_destroy(&pool->own_making);
}

/* Fork. Only the forking thread exists in the child, so locks of other threads are free there. */

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
    mutex_reset(&shared_making);
    threads_reset();
    for (Pool *pool = pools; pool != NULL; pool = pool->next) {
        mutex_reset(&pool->lock);
        mutex_reset(&pool->own_making);
    }
}

#endif

void pool_prepare_process(void) {
    threads_reset();
#if !defined _WIN32
    pthread_atfork(before_fork, after_fork_in_parent, after_fork_in_child);
#endif
}
