/* The first request: what to load, how to step it, and where the shared memory is. */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi/library.h"
#include "worker/worker.h"

#if !defined _WIN32
#include <dlfcn.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>
#endif

/* Shared memory */

#if defined _WIN32

/* A name of memory, or the path of a file in Wine. */
static void *mapping_of(const wchar_t *name) {
    void *mapping = OpenFileMappingW(FILE_MAP_ALL_ACCESS, FALSE, name);

    if (mapping != NULL) {
        return mapping;
    }
    HANDLE file = CreateFileW(name, GENERIC_READ | GENERIC_WRITE,
                              FILE_SHARE_READ | FILE_SHARE_WRITE | FILE_SHARE_DELETE, NULL,
                              OPEN_EXISTING, 0, NULL);
    if (file != INVALID_HANDLE_VALUE) {
        mapping = CreateFileMappingW(file, NULL, PAGE_READWRITE, 0, 0, NULL);
        CloseHandle(file);
    }
    return mapping;
}

static char *map_memory(Worker *w, const char *name, size_t size) {
    wchar_t wide[4096];

    (void)w;
    if (MultiByteToWideChar(CP_UTF8, 0, name, -1, wide, 4096) == 0) {
        return NULL;
    }
    void *mapping = mapping_of(wide);
    char *memory =
        mapping == NULL ? NULL : MapViewOfFile(mapping, FILE_MAP_ALL_ACCESS, 0, 0, size);
    if (mapping != NULL) {
        CloseHandle(mapping);
    }
    return memory;
}

static bool load_before(const char *name, const char *path, char *error, size_t size) {
    char reason[512];

    (void)name;
    if (library_load(path, reason, sizeof reason) != NULL) {
        return true;
    }
    snprintf(error, size, "the library '%s' cannot be loaded: %s", path, reason);
    return false;
}

#else

/* Memory of another size than the request says would end this process later. FMUs that write to a
 * descriptor by mistake must not find this one. */
static char *map_memory(Worker *w, const char *name, size_t size) {
    struct stat file;
    void *memory = MAP_FAILED;

    (void)name;
    if (fstat(w->memory, &file) == 0 && file.st_size >= 0 && (size_t)file.st_size >= size) {
        memory = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, w->memory, 0);
    }
    close(w->memory);
    w->memory = -1;
    return memory == MAP_FAILED ? NULL : memory;
}

/* A library that serves those loaded after it, unless the loader knows another one of its name. */
static bool load_before(const char *name, const char *path, char *error, size_t size) {
    if ((*name != '\0' && dlopen(name, RTLD_LAZY) != NULL) ||
        dlopen(path, RTLD_LAZY | RTLD_GLOBAL) != NULL) {
        return true;
    }
    snprintf(error, size, "the library '%s' cannot be loaded: %s", path, dlerror());
    return false;
}

#endif

static const char *load_all_before(Reader *reader, char *error, size_t size) {
    size_t count, number;
    const char **names = read_texts(reader, &number), **paths = read_texts(reader, &count);
    const char *fault = count == number ? reader->fault : "libraries differ in number";

    for (size_t i = 0; i < count && fault == NULL; i++) {
        fault = load_before(names[i], paths[i], error, size) ? NULL : error;
    }
    free((void *)names);
    free((void *)paths);
    return fault;
}

/* Where an array of so many items begins. */
static void *place(Reader *reader, const Shared *shared, size_t item, size_t items) {
    const size_t size = item * items;
    const int64_t offset = read_integer_in(reader, 0, (int64_t)shared->size);

    if (offset % 8 != 0 || size > shared->size - (size_t)offset) {
        reader_refuse(reader, "an array is outside of the shared memory");
    }
    return shared->base + offset;
}

static void read_places(Worker *w, Reader *reader) {
    Shared *shared = &w->shared;
    const Settings *s = &w->opening.settings;
    const size_t n = s->count;

    shared->inputs = place(reader, shared, sizeof(double), s->inputs->count * n);
    shared->outputs = place(reader, shared, sizeof(double), s->outputs->count * n);
    shared->observations = place(reader, shared, sizeof(float), s->num_observed * n);
    shared->statuses = place(reader, shared, 1, n);
    shared->mask = place(reader, shared, 1, n);
    shared->health = place(reader, shared, sizeof(int64_t), HEALTH_COUNTS * n);
    const size_t echo_size = (size_t)read_integer_in(reader, 8, UINT16_MAX);
    char *echo = place(reader, shared, 1, echo_size);
    const Atomic *bell = place(reader, shared, sizeof(Atomic), 1);
    if (reader->fault == NULL) {
        log_echo_to(echo, echo_size);
        w->channel.bell = bell;
        w->channel.heard = atomic_get(bell);
    }
}

static const char *open_shared(Worker *w, Reader *reader) {
    Shared *shared = &w->shared;
    const char *name = read_text(reader);

    shared->size = (size_t)read_integer_in(reader, 0, PTRDIFF_MAX);
    if (reader->fault != NULL) {
        return reader->fault;
    }
    shared->base = map_memory(w, name, shared->size);
    if (shared->base == NULL) {
        return "the shared memory cannot be mapped";
    }
    read_places(w, reader);
    return reader->fault;
}

static const char *allocate(Worker *w) {
    Settings *s = &w->opening.settings;

    w->output_values = calloc(s->outputs->count * s->count + 1, sizeof *w->output_values);
    w->observations = calloc(s->num_observed * s->count + 1, sizeof *w->observations);
    w->statuses = calloc(s->count, sizeof *w->statuses);
    s->output_values = w->output_values;
    s->status = w->statuses;
    s->health = w->shared.health;
    const bool enough = w->output_values != NULL && w->observations != NULL && w->statuses != NULL;
    return enough ? NULL : "out of memory";
}

/* The outputs of the worker before, as long as nothing else is known. */
static void take_over_outputs(Worker *w) {
    const Settings *s = &w->opening.settings;
    memcpy(w->output_values, w->shared.outputs, s->outputs->count * s->count * sizeof(double));
}

/* Unseeded random numbers are the same in all workers otherwise. */
static void draw_other_numbers(int64_t seed) {
    if (seed != 0) {
        srand((unsigned)seed);
#if !defined _WIN32
        srand48((long)seed);
#endif
    }
}

/* Returns why it did not work, or NULL. */
static const char *open_all(Worker *w, Reader *reader, char *error, size_t size) {
    const Block form = read_block(reader);
    const char *fault = reader->fault;

    fault = fault == NULL ? opening_take(&w->opening, form.bytes, form.size) : fault;
    fault = fault == NULL ? open_shared(w, reader) : fault;
    draw_other_numbers(read_integer(reader));
    fault = fault == NULL ? allocate(w) : fault;
    fault = fault == NULL ? load_all_before(reader, error, size) : fault;
    return fault == NULL ? reader->fault : fault;
}

bool answer_open(Worker *w, Reader *reader) {
    char error[8192];
    const char *fault = open_all(w, reader, error, sizeof error);

    if (fault != NULL) {
        send_error(w, fault);
        return false;
    }
    const bool opened = pool_open(&w->pool, &w->opening.settings, error, sizeof error);
    worker_report(w);
    if (!opened) {
        send_error(w, error);
        return false;
    }
    take_over_outputs(w);
    send_done(w);
    return true;
}
