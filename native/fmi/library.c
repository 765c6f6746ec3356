/* Loads shared libraries and finds functions in them. */

#include "fmi/library.h"

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

enum { DEPTH = 8 }; /* of libraries that need libraries; some need each other */

/* The libraries that a module needs; the last one has no name. NULL if it needs none. */
static const IMAGE_IMPORT_DESCRIPTOR *imports_of(HMODULE module) {
    const char *base = (const char *)module;
    const IMAGE_DOS_HEADER *start = (const IMAGE_DOS_HEADER *)base;
    const IMAGE_NT_HEADERS *headers = (const IMAGE_NT_HEADERS *)(base + start->e_lfanew);
    const IMAGE_DATA_DIRECTORY *imports =
        &headers->OptionalHeader.DataDirectory[IMAGE_DIRECTORY_ENTRY_IMPORT];

    return imports->Size == 0 ? NULL
                              : (const IMAGE_IMPORT_DESCRIPTOR *)(base + imports->VirtualAddress);
}

static void append_name(const char *name, char *names, size_t size) {
    const size_t used = strlen(names);

    if (strstr(names, name) == NULL) {
        snprintf(names + used, size - used, "%s%s", used == 0 ? "" : ", ", name);
    }
}

/* Whether the loader finds a library that lies in no folder of the FMU. */
static bool is_found(const char *name) {
    HMODULE module = LoadLibraryA(name);

    if (module != NULL) {
        FreeLibrary(module);
    }
    return module != NULL;
}

/* Appends the names of libraries that are missing: those that the library at a path needs, or that
 * one beside it needs. The loader itself tells only that there are such libraries. */
static void append_missing(const wchar_t *path, int depth, char *names, size_t size) {
    /* maps the library, but neither runs it nor looks for what it needs */
    HMODULE module = LoadLibraryExW(path, NULL, DONT_RESOLVE_DLL_REFERENCES);
    const wchar_t *end = wcsrchr(path, L'\\');
    const int folder = end == NULL ? 0 : (int)(end - path) + 1;

    if (module == NULL) {
        return;
    }
    const char *base = (const char *)module;
    for (const IMAGE_IMPORT_DESCRIPTOR *i = imports_of(module); i != NULL && i->Name != 0; i++) {
        wchar_t beside[4096];
        const int length = swprintf(beside, 4096, L"%.*ls%hs", folder, path, base + i->Name);
        if (length > 0 && GetFileAttributesW(beside) != INVALID_FILE_ATTRIBUTES) {
            if (depth < DEPTH) {
                append_missing(beside, depth + 1, names, size);
            }
        } else if (!is_found(base + i->Name)) {
            append_name(base + i->Name, names, size);
        }
    }
    FreeLibrary(module);
}

static void describe_failure(const wchar_t *path, unsigned long code, char *error, size_t size) {
    char names[400] = "";

    if (code == ERROR_MOD_NOT_FOUND && GetFileAttributesW(path) != INVALID_FILE_ATTRIBUTES) {
        append_missing(path, 0, names, sizeof names);
    }
    snprintf(error, size, "LoadLibrary failed with Windows error %lu%s%s", code,
             *names == '\0' ? "" : "; it needs libraries that are missing: ", names);
}

void *library_load(const char *path, char *error, size_t size) {
    wchar_t wide[4096] = L"";
    /* searches the library's own folder for those that it depends on */
    const DWORD flags = strpbrk(path, "\\/") == NULL ? 0 : LOAD_WITH_ALTERED_SEARCH_PATH;
    HMODULE handle = NULL;

    if (MultiByteToWideChar(CP_UTF8, 0, path, -1, wide, 4096) != 0) {
        handle = LoadLibraryExW(wide, NULL, flags);
    }
    if (handle == NULL) {
        describe_failure(wide, GetLastError(), error, size);
    }
    return (void *)handle;
}

static void close_handle(void *handle) {
    FreeLibrary((HMODULE)handle);
}

static Function find(void *handle, const char *name) {
    return (Function)GetProcAddress((HMODULE)handle, name);
}

bool library_copy(const char *from, const char *to) {
    wchar_t source[4096], target[4096];

    return MultiByteToWideChar(CP_UTF8, 0, from, -1, source, 4096) != 0 &&
           MultiByteToWideChar(CP_UTF8, 0, to, -1, target, 4096) != 0 &&
           CopyFileW(source, target, FALSE);
}

void library_remove(const char *path) {
    wchar_t wide[4096];

    if (MultiByteToWideChar(CP_UTF8, 0, path, -1, wide, 4096) != 0) {
        DeleteFileW(wide);
    }
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
void *library_load(const char *path, char *error, size_t size) {
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

static bool copy_bytes(FILE *source, FILE *target) {
    char bytes[1 << 16];
    size_t count;

    while ((count = fread(bytes, 1, sizeof bytes, source)) > 0) {
        if (fwrite(bytes, 1, count, target) < count) {
            return false;
        }
    }
    return ferror(source) == 0;
}

bool library_copy(const char *from, const char *to) {
    FILE *source = fopen(from, "rbe"), *target = source == NULL ? NULL : fopen(to, "wbe");
    bool copied = target != NULL && copy_bytes(source, target);

    if (target != NULL) {
        copied &= fclose(target) == 0;
    }
    if (source != NULL) {
        fclose(source);
    }
    return copied;
}

void library_remove(const char *path) {
    unlink(path);
}

#endif

bool library_open(Library *library, const char *path, char *error, size_t size) {
    library->handle = library_load(path, error, size);
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
