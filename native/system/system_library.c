/* Loading the FMUs of a system; making and freeing its instances. */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi/log.h"
#include "system/system.h"

/* What takes the place of a table of functions. */
typedef struct {
    const System *system;
    const char *const *paths;
    Library parts[];
} Loaded;

static Loaded *loaded(const Library *library) {
    return library->functions;
}

static bool load_part(Library *library, const System *system, size_t index, const char *path,
                      char *error, size_t size) {
    const Component *part = &system->parts[index];
    char reason[1200];

    library->identifier = part->model;
    const bool good = library_open(library, path, reason, sizeof reason) &&
                      part->fmi->bind(library, reason, sizeof reason);
    if (!good) {
        snprintf(error, size, "%s: %s", part->label, reason);
    }
    return good;
}

bool system_load(Library *library, const System *system, const char *const *paths, char *error,
                 size_t size) {
    library->functions = calloc(1, sizeof(Loaded) + system->count * sizeof(Library));
    if (library->functions == NULL) {
        snprintf(error, size, "out of memory");
        return false;
    }
    loaded(library)->system = system;
    loaded(library)->paths = paths;
    for (size_t i = 0; i < system->count; i++) {
        if (!load_part(&loaded(library)->parts[i], system, i, paths[i], error, size)) {
            system_unload(library);
            return false;
        }
    }
    return true;
}

void system_unload(Library *library) {
    for (size_t i = 0; library->functions != NULL && i < loaded(library)->system->count; i++) {
        library_close(&loaded(library)->parts[i]);
    }
    library_close(library);
}

/* Instances */

static bool allocate_start(Composite *me) {
    const System *s = me->system;

    me->kept.states = calloc(s->count, sizeof(void *));
    me->kept.slots = calloc(s->inputs + s->outputs + 1, sizeof(double));
    me->kept.useless = calloc(s->count, sizeof(bool));
    return me->kept.states != NULL && me->kept.slots != NULL && me->kept.useless != NULL;
}

static void free_start(Composite *me) {
    free((void *)me->kept.states);
    free(me->kept.slots);
    free(me->kept.useless);
    free(me->kept.key);
    free(me->kept.wanted);
}

static void free_arrays(Composite *me) {
    free(me->parts.dead);
    free(me->parts.started);
    free(me->parts.failed);
    free((void *)me->parts.before);
    free(me->parts.names);
    free_start(me);
    free(me->loop);
    free(me->typed);
    free(me->pending);
    free(me);
}

static bool allocate(Composite *me, const System *s) {
    me->parts.dead = calloc(s->count, sizeof(bool));
    me->parts.started = calloc(s->count, sizeof(bool));
    me->parts.failed = calloc(s->count, sizeof(bool));
    me->parts.before = calloc(s->count, sizeof(void *));
    me->parts.names = calloc(s->count, LOG_NAME);
    me->loop = calloc(s->memory + 1, sizeof(double));
    me->typed = calloc(2 * (s->scratch + 1), sizeof(double));
    me->whole = me->typed == NULL ? NULL : me->typed + s->scratch + 1;
    return me->parts.dead != NULL && me->parts.started != NULL && me->parts.failed != NULL &&
           me->parts.before != NULL && me->parts.names != NULL && me->loop != NULL &&
           me->typed != NULL && allocate_start(me);
}

/* The slots follow the instance, so that a step finds all of it in a few cache lines. */
static Composite *in_one_block(const System *s) {
    const size_t words = s->count + s->inputs + s->outputs;
    Composite *me = calloc(1, sizeof *me + words * sizeof(double));

    if (me != NULL) {
        me->system = s;
        me->inputs = (double *)(void *)(me + 1);
        me->outputs = me->inputs + s->inputs;
        me->components = (void **)(void *)(me->outputs + s->outputs);
    }
    return me;
}

bool part_instantiate(Composite *me, size_t index) {
    const Component *part = &me->system->parts[index];
    char *name = me->parts.names + index * LOG_NAME;

    log_name(name, part->name, me->environment + index);
    const Identity identity = {
        .name = name,
        .token = part->token,
        .resources = part->resources,
        .environment = me->environment + index,
        .logging = me->logging,
        .solving = &part->solving,
        .floats = me->floats,
    };
    me->components[index] = part->fmi->instantiate(&me->libraries[index], &identity);
    floats_restore_if_seen(me->floats);
    return me->components[index] != NULL;
}

void *system_instantiate(const Library *library, const Identity *identity) {
    const System *system = loaded(library)->system;
    Composite *me = in_one_block(system);

    if (me == NULL) {
        return NULL;
    }
    me->libraries = loaded(library)->parts;
    me->paths = loaded(library)->paths;
    me->floats = identity->floats;
    me->environment = identity->environment;
    me->logging = identity->logging;
    bool good = allocate(me, system);
    for (size_t i = 0; i < system->count && good; i++) {
        good = part_instantiate(me, i);
    }
    if (!good) {
        system_free(library, me);
    }
    return good ? me : NULL;
}

void part_free_state(Composite *me, size_t index, void **state) {
    if (*state != NULL) {
        me->system->parts[index].fmi->free_state(&me->libraries[index], me->components[index],
                                                 state);
    }
    *state = NULL;
}

void part_free(Composite *me, size_t index) {
    part_free_state(me, index, &me->parts.before[index]);
    part_free_state(me, index, &me->kept.states[index]);
    me->system->parts[index].fmi->free_instance(&me->libraries[index], me->components[index]);
    me->components[index] = NULL;
    floats_restore_if_seen(me->floats);
}

bool part_reload(Composite *me, size_t index) {
    Library *library = &me->libraries[index];
    char unused[256];

    library_close(library);
    memset(library, 0, sizeof *library);
    const bool good =
        load_part(library, me->system, index, me->paths[index], unused, sizeof unused);
    floats_restore_if_seen(me->floats);
    return good;
}

/* FMI forbids every call after a fatal error, so the FMU's memory of such a part is lost. */
void system_free(const Library *library, void *component) {
    Composite *me = component;
    const bool complete =
        me->parts.dead != NULL && me->parts.before != NULL && me->kept.states != NULL;

    (void)library;
    for (size_t i = 0; complete && i < me->system->count; i++) {
        if (me->components[i] != NULL && !me->parts.dead[i]) {
            part_free(me, i);
        }
    }
    free_arrays(me);
}

void system_drop(const Library *library, void *component) {
    system_free(library, component);
}

Status part_choose_messages(Composite *me, size_t index) {
    const Component *part = &me->system->parts[index];

    if (part->fmi->choose_messages == NULL || part->number_of_categories == 0) {
        return STATUS_OK;
    }
    return part_judge(me, index, part->fmi->choose_messages(
                                     &me->libraries[index], me->components[index],
                                     part->categories, me->hears ? part->number_of_categories : 0));
}

Status system_choose_messages(const Library *library, void *component,
                              const char *const *categories, size_t count) {
    Composite *me = component;
    Status worst = STATUS_OK;

    (void)library;
    (void)categories; /* each part has its own */
    me->has_chosen = true;
    me->hears = count > 0;
    for (size_t i = 0; i < me->system->count; i++) {
        const Status status = part_choose_messages(me, i);
        worst = status > worst ? status : worst;
    }
    return worst;
}

Status system_terminate(const Library *library, void *component) {
    Composite *me = component;
    Status worst = STATUS_OK;

    (void)library;
    for (size_t i = 0; i < me->system->count; i++) {
        if (me->parts.started[i] && !me->parts.dead[i]) {
            const Status status = part_judge(
                me, i, me->system->parts[i].fmi->terminate(&me->libraries[i],
                                                           me->components[i]));
            worst = status > worst ? status : worst;
        }
    }
    return worst;
}
