/* Loading the FMUs of a system; making, resetting and freeing its instances. */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "log.h"
#include "remote.h"
#include "system.h"

/* What takes the place of a table of functions. */
typedef struct {
    const System *system;
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
    const bool good = part->remote != NULL
                          ? remote_open(library, part, system->count, reason, sizeof reason)
                          : library_open(library, path, reason, sizeof reason) &&
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
        if (loaded(library)->system->parts[i].remote != NULL) {
            remote_close(&loaded(library)->parts[i]);
        }
        library_close(&loaded(library)->parts[i]);
    }
    library_close(library);
}

/* Instances */

static void free_arrays(Composite *me) {
    free(me->parts.dead);
    free(me->parts.started);
    free((void *)me->parts.before);
    free(me->parts.names);
    free(me->loop);
    free(me->typed);
    free(me->pending);
    free(me);
}

static bool allocate(Composite *me, const System *s) {
    me->parts.dead = calloc(s->count, sizeof(bool));
    me->parts.started = calloc(s->count, sizeof(bool));
    me->parts.before = calloc(s->count, sizeof(void *));
    me->parts.names = calloc(s->count, LOG_NAME);
    me->loop = calloc(s->memory + 1, sizeof(double));
    me->typed = calloc(s->scratch + 1, sizeof(double));
    return me->parts.dead != NULL && me->parts.started != NULL && me->parts.before != NULL &&
           me->parts.names != NULL && me->loop != NULL && me->typed != NULL;
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

static bool instantiate_part(Composite *me, size_t index, const Identity *whole) {
    const Component *part = &me->system->parts[index];
    char *name = me->parts.names + index * LOG_NAME;

    log_name(name, part->name, whole->environment + index);
    const Identity identity = {
        .name = name,
        .token = part->token,
        .resources = part->resources,
        .environment = whole->environment + index,
        .logging = whole->logging,
        .solving = &part->solving,
        .floats = whole->floats,
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
    me->floats = identity->floats;
    bool good = allocate(me, system);
    for (size_t i = 0; i < system->count && good; i++) {
        good = instantiate_part(me, i, identity);
    }
    if (!good) {
        system_free(library, me);
    }
    return good ? me : NULL;
}

static void free_part(Composite *me, size_t index) {
    const Fmi *fmi = me->system->parts[index].fmi;
    void *component = me->components[index];

    if (me->parts.before[index] != NULL) {
        fmi->free_state(&me->libraries[index], component, &me->parts.before[index]);
    }
    fmi->free_instance(&me->libraries[index], component);
    floats_restore_if_seen(me->floats);
}

/* FMI forbids every call after a fatal error, so the FMU's memory of such a part is lost. */
void system_free(const Library *library, void *component) {
    Composite *me = component;
    const bool complete = me->parts.dead != NULL && me->parts.before != NULL;

    (void)library;
    for (size_t i = 0; complete && i < me->system->count; i++) {
        const Fmi *fmi = me->system->parts[i].fmi;
        if (me->components[i] != NULL && !me->parts.dead[i]) {
            free_part(me, i);
        } else if (me->components[i] != NULL && fmi->drop != NULL) {
            fmi->drop(&me->libraries[i], me->components[i]);
        }
    }
    free_arrays(me);
}

void system_drop(const Library *library, void *component) {
    system_free(library, component);
}

Status system_choose_messages(const Library *library, void *component,
                              const char *const *categories, size_t count) {
    Composite *me = component;
    Status worst = STATUS_OK;

    (void)library;
    (void)categories; /* each part has its own */
    for (size_t i = 0; i < me->system->count; i++) {
        const Component *part = &me->system->parts[i];
        if (part->fmi->choose_messages != NULL && part->number_of_categories > 0) {
            const Status status = part_judge(
                me, i, part->fmi->choose_messages(&me->libraries[i], me->components[i],
                                                  part->categories,
                                                  count > 0 ? part->number_of_categories : 0));
            worst = status > worst ? status : worst;
        }
    }
    return worst;
}

static Status reset_part(Composite *me, size_t index) {
    if (me->parts.dead[index]) {
        return STATUS_ERROR;
    }
    if (!me->parts.started[index]) {
        return STATUS_OK;
    }
    const Status status = part_judge(
        me, index, me->system->parts[index].fmi->reset(&me->libraries[index],
                                                       me->components[index]));
    me->parts.started[index] = status > STATUS_WARNING;
    return status;
}

Status system_reset(const Library *library, void *component) {
    Composite *me = component;
    Status worst = STATUS_OK;

    (void)library;
    me->blamed = NULL;
    for (size_t i = 0; i < me->system->count; i++) {
        const Status status = reset_part(me, i);
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
