/* Copies of a pool's library, for FMUs that allow only some instances with one. */

#include "pool/copies.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi/library.h"
#include "pool/failures.h"
#include "pool/loading.h"

struct LibraryCopy {
    struct LibraryCopy *next; /* an older one */
    Library library;
    size_t users; /* instances that have it */
    char **paths; /* of the files, one for each FMU of an instance */
};

/* Of the library that an instance has at first. */
static size_t number_of(const Pool *pool, const Instance *me) {
    return pool->settings.private_libraries ? index_of(pool, me) : 0;
}

static const char *const *paths_of(const Pool *pool, const Instance *me) {
    return pool->settings.paths + number_of(pool, me) * parts_of(&pool->settings);
}

/* Another name in the same folder, where the library finds what it needs. Other processes may make
 * copies there, too. */
static char *name_copy(const char *path, unsigned number) {
    const size_t size = strlen(path) + 40;
    char *name = malloc(size);
    const char *end = path + strlen(path);

    while (end > path && end[-1] != '/' && end[-1] != '\\') {
        end--;
    }
    if (name != NULL) {
        snprintf(name, size, "%.*scopy-%u-%u-%s", (int)(end - path), path,
                 (unsigned)number_of_process(), number, end);
    }
    return name;
}

static void delete_copy(Pool *pool, LibraryCopy *copy) {
    pool_unload_from(pool, &copy->library);
    for (size_t i = 0; copy->paths != NULL && i < parts_of(&pool->settings); i++) {
        if (copy->paths[i] != NULL) {
            library_remove(copy->paths[i]);
        }
        free(copy->paths[i]);
    }
    free((void *)copy->paths);
    free(copy);
}

static bool copy_files(Pool *pool, LibraryCopy *copy, const char *const *paths) {
    const size_t parts = parts_of(&pool->settings);

    copy->paths = calloc(parts, sizeof *copy->paths);
    for (size_t i = 0; copy->paths != NULL && i < parts; i++) {
        copy->paths[i] = name_copy(paths[i], pool->copies_made++);
        if (copy->paths[i] == NULL || !library_copy(paths[i], copy->paths[i])) {
            return false;
        }
    }
    return copy->paths != NULL;
}

static LibraryCopy *make_copy(Pool *pool, const Instance *me) {
    LibraryCopy *copy = calloc(1, sizeof *copy);
    char unused[256];

    if (copy == NULL) {
        return NULL;
    }
    if (!copy_files(pool, copy, paths_of(pool, me)) ||
        !pool_load_from(pool, &copy->library, (const char *const *)copy->paths, unused,
                        sizeof unused)) {
        delete_copy(pool, copy);
        copy = NULL;
    }
    floats_restore(&pool->floats); /* loading a library runs code, too */
    return copy;
}

/* The copy that an instance has, or NULL. */
static LibraryCopy *copy_of(const Pool *pool, const Instance *me) {
    LibraryCopy *copy = pool->copies;

    while (copy != NULL && me->library != &copy->library) {
        copy = copy->next;
    }
    return copy;
}

static void leave(Pool *pool, Instance *me) {
    LibraryCopy *copy = copy_of(pool, me), **link = &pool->copies;

    me->library = &pool->libraries[number_of(pool, me)];
    if (copy == NULL || --copy->users > 0) {
        return;
    }
    while (*link != copy) {
        link = &(*link)->next;
    }
    *link = copy->next;
    delete_copy(pool, copy);
}

static bool take(Pool *pool, Instance *me, bool *is_new) {
    LibraryCopy *copy = pool->settings.private_libraries ? NULL : pool->copies;

    *is_new = copy == NULL || me->library == &copy->library;
    if (*is_new) {
        copy = make_copy(pool, me);
        if (copy == NULL) {
            return false;
        }
        copy->next = pool->copies;
        pool->copies = copy;
    }
    copy->users++; /* before the instance leaves the one that it has, which may be older */
    leave(pool, me);
    me->library = &copy->library;
    return true;
}

bool copy_take(Pool *pool, Instance *me, bool *is_new) {
    mutex_lock(pool->making);
    const bool taken = take(pool, me, is_new);
    mutex_unlock(pool->making);
    return taken;
}

void copy_leave(Pool *pool, Instance *me) {
    mutex_lock(pool->making);
    leave(pool, me);
    mutex_unlock(pool->making);
}

void copies_close(Pool *pool) {
    for (LibraryCopy *copy = pool->copies, *next; copy != NULL; copy = next) {
        next = copy->next;
        delete_copy(pool, copy);
    }
    pool->copies = NULL;
}
