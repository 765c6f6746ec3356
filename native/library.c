/* Loads shared libraries and finds functions in them. */

#include "library.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
#else
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <unistd.h>
#endif

#if defined _WIN32

static void *open_handle(const char *path, char *error, size_t size) {
    wchar_t wide[4096];
    HMODULE handle = NULL;

    if (MultiByteToWideChar(CP_UTF8, 0, path, -1, wide, 4096) != 0) {
        /* searches the FMU's own folder for the libraries that it depends on */
        handle = LoadLibraryExW(wide, NULL, LOAD_WITH_ALTERED_SEARCH_PATH);
    }
    if (handle == NULL) {
        snprintf(error, size, "LoadLibrary failed with Windows error %lu", GetLastError());
    }
    return (void *)handle;
}

static void close_handle(void *handle) {
    FreeLibrary((HMODULE)handle);
}

static Function find(void *handle, const char *name) {
    return (Function)GetProcAddress((HMODULE)handle, name);
}

#else

/* Returns a descriptor of the old working directory; -1 if nothing was changed. */
static int enter_folder_of(const char *path) {
    const char *end = strrchr(path, '/');
    char *folder = end == NULL ? NULL : strndup(path, (size_t)(end - path));
    int here = folder == NULL ? -1 : open(".", O_RDONLY | O_CLOEXEC);

    if (here >= 0 && chdir(folder) != 0) {
        close(here);
        here = -1;
    }
    free(folder);
    return here;
}

static void leave_folder(int here) {
    if (here >= 0) {
        const int failed = fchdir(here); /* the old directory cannot be refused: it was in use */
        (void)failed;
        close(here);
    }
}

/* Some libraries read files of their own folder when they are loaded. */
static void *open_handle(const char *path, char *error, size_t size) {
    static pthread_mutex_t loading = PTHREAD_MUTEX_INITIALIZER;

    pthread_mutex_lock(&loading);
    const int here = enter_folder_of(path);
    void *handle = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    if (handle == NULL) {
        const char *reason = dlerror();
        snprintf(error, size, "%s", reason == NULL ? "dlopen failed" : reason);
    }
    leave_folder(here);
    pthread_mutex_unlock(&loading);
    return handle;
}

static void close_handle(void *handle) {
    dlclose(handle);
}

static Function find(void *handle, const char *name) {
    /* ISO C has no conversion from a data pointer to a function pointer; POSIX says they match */
    void *symbol = dlsym(handle, name);
    Function function = NULL;
    memcpy(&function, &symbol, sizeof function);
    return function;
}

#endif

bool library_open(Library *library, const char *path, char *error, size_t size) {
    library->handle = open_handle(path, error, size);
    return library->handle != NULL;
}

void library_close(Library *library) {
    if (library->handle != NULL) {
        close_handle(library->handle);
    }
    free(library->functions);
    library->handle = NULL;
    library->functions = NULL;
}

static bool bind_one(Library *library, const char *prefix, const Binding *binding, char *error,
                     size_t size) {
    char name[512];
    const int length = snprintf(name, sizeof name, "%s%s", prefix, binding->name);
    const bool fits = length > 0 && (size_t)length < sizeof name;
    const Function function = fits ? find(library->handle, name) : NULL;

    memcpy((char *)library->functions + binding->offset, &function, sizeof function);
    if (binding->required && function == NULL) {
        snprintf(error, size, "it does not export %.400s", name);
        return false;
    }
    return true;
}

bool library_bind(Library *library, const char *prefix, const Binding *bindings, size_t count,
                  size_t table_size, char *error, size_t size) {
    library->functions = calloc(1, table_size);
    if (library->functions == NULL) {
        snprintf(error, size, "out of memory");
        return false;
    }
    for (size_t i = 0; i < count; i++) {
        if (!bind_one(library, prefix, &bindings[i], error, size)) {
            return false;
        }
    }
    return true;
}
