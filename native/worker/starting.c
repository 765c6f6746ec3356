/* Starts of episodes. */

#include <stdlib.h>
#include <string.h>

#include "worker/worker.h"

#if defined _WIN32
/* Windows' own header of this function needs another library. */
typedef struct {
    DWORD size, page_faults;
    SIZE_T peak_working_set, working_set, quotas[4], pagefile, peak_pagefile;
} MemoryCounters;
WINBASEAPI BOOL WINAPI K32GetProcessMemoryInfo(HANDLE process, MemoryCounters *counters,
                                               DWORD size);
#elif defined __linux__
#include <stdio.h>
#include <unistd.h>
#else
#include <sys/resource.h>
#endif

enum { FIRST_RESETS = 4 }; /* of each instance; what they take is no leak */

/* The memory that this process takes, without the pages of files; on macOS the most that it has ever
 * taken. */
static int64_t memory_of_process(void) {
#if defined _WIN32
    MemoryCounters counters = {.size = sizeof counters};
    const BOOL known = K32GetProcessMemoryInfo(GetCurrentProcess(), &counters, sizeof counters);
    return known ? (int64_t)counters.working_set : 0;
#elif defined __linux__
    long all, resident = 0, shared = 0;
    FILE *file = fopen("/proc/self/statm", "re");
    if (file == NULL || fscanf(file, "%ld %ld %ld", &all, &resident, &shared) != 3) {
        resident = shared = 0;
    }
    if (file != NULL) {
        fclose(file);
    }
    return (int64_t)(resident - shared) * sysconf(_SC_PAGESIZE);
#else
    struct rusage usage;
    return getrusage(RUSAGE_SELF, &usage) == 0 ? (int64_t)usage.ru_maxrss : 0;
#endif
}

/* By how many bytes the process has grown since its first resets. */
static int64_t growth_after_start(Worker *w) {
    const size_t count = w->opening.settings.count;

    for (size_t i = 0; i < count; i++) {
        w->resets += w->shared.mask[i] != 0;
    }
    if (w->resets < FIRST_RESETS * (int64_t)count) {
        return 0;
    }
    const int64_t now = memory_of_process();
    w->first_memory = w->first_memory == 0 ? now : w->first_memory;
    return now - w->first_memory;
}

Matrix shared_inputs(const Worker *w) {
    return (Matrix){(const char *)w->shared.inputs,
                    (ptrdiff_t)(w->opening.settings.count * sizeof(double)), sizeof(double)};
}

static const Access *known_list(const Worker *w, Block form) {
    for (size_t i = 0; i < w->number_of_lists; i++) {
        const List *list = &w->lists[i];
        if (list->size == form.size && memcmp(list->form, form.bytes, form.size) == 0) {
            return &list->access;
        }
    }
    return NULL;
}

/* The list of a start, which stays: states of instances belong to it. */
static const Access *find_list(Worker *w, Reader *reader) {
    const Block form = read_block(reader);
    const Access *known = reader->fault == NULL ? known_list(w, form) : NULL;

    if (known != NULL || reader->fault != NULL) {
        return known;
    }
    w->lists = memory_for(w->lists, (w->number_of_lists + 1) * sizeof *w->lists);
    List *list = &w->lists[w->number_of_lists];
    list->form = memcpy(memory_for(NULL, form.size), form.bytes, form.size);
    list->size = form.size;
    Reader own = {list->form, list->form + form.size, NULL};
    if (!read_access(&own, w->opening.settings.fmi, &list->access)) {
        reader_refuse(reader, own.fault);
        access_close(&list->access);
        free(list->form);
        return NULL;
    }
    w->number_of_lists++;
    return &list->access;
}

/* The values of a list of variables, one column for each instance. */
static Matrix take_values(Worker *w, Reader *reader, const Access *access) {
    const size_t n = w->opening.settings.count, count = access == NULL ? 0 : access->count;
    size_t values;
    const double *first = read_array(reader, sizeof *first, &values);

    if (values != count * n) {
        reader_refuse(reader, "the values of variables differ in number");
    }
    return (Matrix){(const char *)first, (ptrdiff_t)(n * sizeof(double)), sizeof(double)};
}

Answer answer_start(Worker *w, Reader *reader, Writer *writer) {
    const Access *start = find_list(w, reader);
    const Matrix values = take_values(w, reader, start);
    const Call call = {.inputs = shared_inputs(w),
                       .start = start,
                       .start_values = values,
                       .mask = {w->shared.mask, 1},
                       .observations = w->observations};

    if (reader->fault == NULL) {
        pool_reset(&w->pool, &call);
        write_integer(writer, growth_after_start(w));
        write_integer(writer, (int64_t)number_of_initializations());
    }
    return answer_after(&w->pool, reader, writer, -1);
}
