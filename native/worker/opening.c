/* The first request: what to load, how to step it, and where the shared memory is. */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "worker.h"

bool read_access(Reader *reader, const Fmi *fmi, Access *access) {
    Block blocks[4];
    Listing listing;

    for (int i = 0; i < 4; i++) {
        blocks[i].bytes = read_block(reader, &blocks[i].size);
    }
    return reader->sound &&
           listing_take(&listing, blocks[0], blocks[1], blocks[2], blocks[3]) == NULL &&
           access_open(access, fmi, &listing);
}

/* Shared memory */

static char *map_file(const char *path, size_t size) {
    wchar_t wide[4096];

    if (MultiByteToWideChar(CP_UTF8, 0, path, -1, wide, 4096) == 0) {
        return NULL;
    }
    HANDLE file = CreateFileW(wide, GENERIC_READ | GENERIC_WRITE,
                              FILE_SHARE_READ | FILE_SHARE_WRITE | FILE_SHARE_DELETE, NULL,
                              OPEN_EXISTING, 0, NULL);
    if (file == INVALID_HANDLE_VALUE) {
        return NULL;
    }
    HANDLE mapping = CreateFileMappingW(file, NULL, PAGE_READWRITE, 0, 0, NULL);
    char *memory =
        mapping == NULL ? NULL : MapViewOfFile(mapping, FILE_MAP_ALL_ACCESS, 0, 0, size);
    if (mapping != NULL) {
        CloseHandle(mapping);
    }
    CloseHandle(file);
    return memory;
}

static void *place(const Shared *shared, Reader *reader, size_t element, size_t first) {
    const uint64_t offset = (uint64_t)read_integer(reader);

    if (offset > shared->size) {
        reader->sound = false;
        return NULL;
    }
    return shared->base + offset + element * first;
}

static bool open_shared(Worker *w, Reader *reader, size_t num_observed) {
    Shared *shared = &w->shared;
    const char *path = read_text(reader);

    shared->size = (uint64_t)read_integer(reader);
    shared->stride = (size_t)read_integer(reader);
    const size_t first = (size_t)read_integer(reader);
    shared->base = reader->sound ? map_file(path, (size_t)shared->size) : NULL;
    if (shared->base == NULL) {
        return false;
    }
    shared->inputs = place(shared, reader, sizeof(double), first);
    shared->outputs = place(shared, reader, sizeof(double), first);
    shared->observations = place(shared, reader, sizeof(float) * num_observed, first);
    shared->statuses = place(shared, reader, 1, first);
    shared->mask = place(shared, reader, 1, first);
    shared->health = place(shared, reader, sizeof(int64_t) * HEALTH_COUNTS, first);
    char *echo = place(shared, reader, 1, 0);
    const size_t echo_size = (size_t)read_integer(reader);
    if (reader->sound) {
        log_echo_to(echo, echo_size);
        frames_watch((const Atomic *)(echo + echo_size));
    }
    return reader->sound;
}

/* Settings, in the order of fmugym/pool/process/windows.py */

static const char *const *read_texts(Reader *reader, size_t *count) {
    const int64_t number = read_integer(reader);
    const char **texts = number < 0 || number > INT32_MAX ? NULL : calloc((size_t)number + 1, sizeof *texts);

    *count = texts == NULL ? 0 : (size_t)number;
    reader->sound = reader->sound && texts != NULL;
    for (size_t i = 0; i < *count; i++) {
        texts[i] = read_text(reader);
    }
    return texts;
}

/* Copies a block of value references, one for each state; NULL if it is empty. */
static const uint32_t *read_references(Reader *reader, size_t states) {
    size_t size;
    const char *bytes = read_block(reader, &size);
    uint32_t *references = malloc(size + 1);

    reader->sound = reader->sound && references != NULL &&
                    (size == 0 || size == states * sizeof *references);
    if (!reader->sound || size == 0) {
        free(references);
        return NULL;
    }
    return memcpy(references, bytes, size);
}

/* Copies a block of elements of this size; NULL if it is empty. */
static const void *read_copy(Reader *reader, size_t size, size_t *count) {
    size_t total;
    const char *bytes = read_block(reader, &total);
    void *copy = malloc(total + 1);

    reader->sound = reader->sound && copy != NULL && total % size == 0;
    *count = reader->sound ? total / size : 0;
    if (*count == 0) {
        free(copy);
        return NULL;
    }
    return memcpy(copy, bytes, total);
}

static void read_solving(Reader *reader, Solving *solving) {
    solving->method = method_of(read_text(reader));
    solving->tolerance = read_number(reader);
    solving->max_step = read_number(reader);
    solving->states = (size_t)read_integer(reader);
    solving->indicators = (size_t)read_integer(reader);
    solving->completes = read_flag(reader);
    solving->state_references = read_references(reader, solving->states);
    solving->rate_references = read_references(reader, solving->states);
    solving->clocks = read_copy(reader, sizeof(Clock), &solving->number_of_clocks);
    solving->clocked = read_copy(reader, sizeof(Clocked), &solving->number_of_clocked);
    reader->sound = reader->sound && solving->method != NULL;
}

static void read_library(Reader *reader, Settings *s) {
    size_t paths;
    const int64_t version = read_integer(reader);
    const int64_t manner = read_integer(reader);

    s->fmi = fmi_table(version, manner);
    if (read_flag(reader)) {
        read_solving(reader, &s->solving);
    }
    s->model = read_text(reader);
    s->token = read_text(reader);
    s->resources = read_text(reader);
    s->paths = read_texts(reader, &paths);
    s->logging = read_flag(reader);
    s->can_save = read_flag(reader);
    s->categories = read_texts(reader, &s->number_of_categories);
    size_t size;
    s->experiment.structural_references = read_block(reader, &size);
    s->experiment.number_of_structural = size / sizeof(uint32_t);
    s->experiment.structural_values = read_block(reader, &size);
    reader->sound = reader->sound && s->fmi != NULL && paths == 1 &&
                    size == s->experiment.number_of_structural * sizeof(uint64_t);
    if (reader->sound) {
        s->can_save = s->can_save && s->fmi->get_state != NULL;
    }
}

static void read_experiment(Reader *reader, Settings *s) {
    s->experiment.start_time = read_number(reader);
    s->experiment.has_stop_time = read_flag(reader);
    s->experiment.stop_time = read_number(reader);
    s->experiment.has_tolerance = read_flag(reader);
    s->experiment.tolerance = read_number(reader);
    s->time_step = read_number(reader);
    s->substeps = read_integer(reader);
    s->warm_up_steps = read_integer(reader);
    s->retries = s->can_save ? read_integer(reader) : 0 * read_integer(reader);
    s->restores = read_flag(reader) && s->can_save;
    s->rebuilds = read_flag(reader);
    s->reloads = read_flag(reader);
    s->one_initialization = read_flag(reader);
    s->records = read_flag(reader);
}

static void read_variables(Worker *w, Reader *reader) {
    Settings *s = &w->settings;
    size_t size;

    reader->sound = reader->sound && read_access(reader, s->fmi, &w->inputs) &&
                    read_access(reader, s->fmi, &w->outputs);
    s->inputs = &w->inputs;
    s->outputs = &w->outputs;
    s->num_observed = (size_t)read_integer(reader);
    s->sampling = (const unsigned char *)read_block(reader, &size);
    s->sampling = size == 0 ? NULL : s->sampling;
    reader->sound = reader->sound && (size == 0 || size == w->outputs.count) &&
                    s->num_observed <= w->outputs.count;
    const char *starts = read_block(reader, &size);
    s->start_outputs = size == 0 ? NULL : starts;
    s->count = (size_t)read_integer(reader);
    s->threads = (size_t)read_integer(reader);
}

static bool allocate(Worker *w) {
    Settings *s = &w->settings;

    w->output_values = calloc(w->outputs.count * s->count + 1, sizeof *w->output_values);
    w->observations = calloc(s->num_observed * s->count + 1, sizeof *w->observations);
    w->statuses = calloc(s->count, sizeof *w->statuses);
    s->output_values = w->output_values;
    s->status = w->statuses;
    s->health = w->shared.health;
    return w->output_values != NULL && w->observations != NULL && w->statuses != NULL;
}

/* The outputs of the worker before, as long as nothing else is known. */
static void take_over_outputs(Worker *w) {
    const size_t count = w->settings.count;

    for (size_t i = 0; i < w->outputs.count; i++) {
        memcpy(w->output_values + i * count, w->shared.outputs + i * w->shared.stride,
               count * sizeof(double));
    }
}

bool worker_open(Worker *w, Reader *reader, char *error, size_t size) {
    read_library(reader, &w->settings);
    read_experiment(reader, &w->settings);
    read_variables(w, reader);
    if (!reader->sound) {
        snprintf(error, size, "the first request is damaged");
        return false;
    }
    if (!open_shared(w, reader, w->settings.num_observed) || !allocate(w)) {
        snprintf(error, size, "the shared memory cannot be mapped: Windows error %lu",
                 GetLastError());
        return false;
    }
    if (!pool_open(&w->pool, &w->settings, error, size)) {
        return false;
    }
    take_over_outputs(w);
    return true;
}
