#include "loading.h"

#include "system.h"

size_t parts_of(const Settings *settings) {
    return settings->system == NULL ? 1 : settings->system->count;
}

bool pool_load(Pool *pool, size_t index, char *error, size_t size) {
    const Settings *s = &pool->settings;
    const char *const *paths = s->paths + index * parts_of(s);
    Library *library = &pool->libraries[index];

    library->identifier = s->model;
    if (s->system != NULL) {
        return system_load(library, s->system, paths, error, size);
    }
    return library_open(library, *paths, error, size) && s->fmi->bind(library, error, size);
}

void pool_unload(Pool *pool, size_t index) {
    if (pool->settings.system != NULL) {
        system_unload(&pool->libraries[index]);
    } else {
        library_close(&pool->libraries[index]);
    }
}
