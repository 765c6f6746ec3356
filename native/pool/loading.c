/* Loading of the library of an FMU, or of the libraries of a system. */

#include "pool/loading.h"

#include "system/system.h"

size_t parts_of(const Settings *settings) {
    return settings->system == NULL ? 1 : settings->system->count;
}

bool pool_load_from(Pool *pool, Library *library, const char *const *paths, char *error,
                    size_t size) {
    const Settings *s = &pool->settings;

    library->identifier = s->model;
    if (s->system != NULL) {
        return system_load(library, s->system, paths, error, size);
    }
    return library_open(library, *paths, error, size) && s->fmi->bind(library, error, size);
}

void pool_unload_from(Pool *pool, Library *library) {
    if (pool->settings.system != NULL) {
        system_unload(library);
    } else {
        library_close(library);
    }
}

bool pool_load(Pool *pool, size_t index, char *error, size_t size) {
    const Settings *s = &pool->settings;
    return pool_load_from(pool, &pool->libraries[index], s->paths + index * parts_of(s), error,
                          size);
}

void pool_unload(Pool *pool, size_t index) {
    pool_unload_from(pool, &pool->libraries[index]);
}
