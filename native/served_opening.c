/* The first request to the worker of a component: what to load. remote_library.c writes it. */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if !defined _WIN32
#include <dlfcn.h>
#endif

#include "serving.h"

static const char **take_texts(size_t *count) {
    uint64_t number;

    TAKE(&served.in, number);
    const char **texts = serving_memory(NULL, (size_t)number * sizeof *texts);
    for (*count = 0; *count < number && served.in.sound; ++*count) {
        texts[*count] = serving_copy(packet_take_text(&served.in));
    }
    return texts;
}

static void take_solving(Solving *s) {
    size_t size;

    const char *method = packet_take_text(&served.in);
    s->method = *method == '\0' ? NULL : method_of(method);
    TAKE(&served.in, s->tolerance);
    TAKE(&served.in, s->max_step);
    s->states = serving_take_size();
    s->indicators = serving_take_size();
    TAKE(&served.in, s->completes);
    s->state_references = serving_take_copy(&size);
    s->rate_references = serving_take_copy(&size);
    s->clocks = serving_take_copy(&size);
    s->number_of_clocks = size / sizeof(Clock);
    s->clocked = serving_take_copy(&size);
    s->number_of_clocked = size / sizeof(Clocked);
}

static void take_batches(Batches *batches) {
    uint64_t count;

    TAKE(&served.in, count);
    batches->count = count <= NUMBER_OF_TYPES ? (size_t)count : 0;
    for (size_t i = 0; i < batches->count && served.in.sound; i++) {
        Batch *batch = &batches->batches[i];
        const size_t type = serving_take_size();
        size_t size;
        batch->type = (Type)(type < NUMBER_OF_TYPES ? type : 0);
        batch->size = serving_take_size() * value_size(served.fmi, batch->type);
        batch->references = serving_take_copy(&size);
        batch->count = size / sizeof *batch->references;
    }
}

/* Libraries that the FMU's own one needs. */
static bool load_before(char *error, size_t size) {
    size_t count;
    const char **paths = take_texts(&count);
    bool good = true;

    for (size_t i = 0; i < count && good; i++) {
#if !defined _WIN32
        good = dlopen(paths[i], RTLD_NOW | RTLD_GLOBAL) != NULL;
        snprintf(error, size, "%s", good ? "" : dlerror());
#else
        snprintf(error, size, "%s cannot be loaded first in Wine", paths[i]);
        good = false;
#endif
    }
    return good;
}

static bool open_library(char *error, size_t size) {
    int64_t version, manner;
    size_t size_of_references, size_of_values;

    TAKE(&served.in, version);
    TAKE(&served.in, manner);
    served.fmi = version == 0 ? NULL : fmi_table(version, manner);
    served.library.identifier = serving_copy(packet_take_text(&served.in));
    served.token = serving_copy(packet_take_text(&served.in));
    served.resources = serving_copy(packet_take_text(&served.in));
    const char *path = serving_copy(packet_take_text(&served.in));
    served.categories = take_texts(&served.number_of_categories);
    take_solving(&served.solving);
    served.structural_references = serving_take_copy(&size_of_references);
    served.number_of_structural = size_of_references / sizeof(uint32_t);
    served.structural_values = serving_take_copy(&size_of_values);
    if (!served.in.sound || served.fmi == NULL) {
        snprintf(error, size, "the first request is damaged");
        return false;
    }
    take_batches(&served.inputs);
    take_batches(&served.outputs);
    return load_before(error, size) && library_open(&served.library, path, error, size) &&
           served.fmi->bind(&served.library, error, size);
}

void serving_open(void) {
    char error[1024] = "";
    const bool opened = open_library(error, sizeof error);

    floats_restore(&served.floats);
    packet_clear(&served.out);
    PUT(&served.out, opened);
    packet_put_text(&served.out, error);
}
