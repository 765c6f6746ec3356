#include "serving.h"

#include <stdlib.h>
#include <string.h>

#if !defined _WIN32
#include <unistd.h>
#endif

Served served; /* the FMU that this process has been started for */

void serving_end(int status) {
#if defined _WIN32
    ExitProcess((UINT)status);
#else
    _exit(status);
#endif
}

void *serving_memory(void *old, size_t size) {
    void *memory = realloc(old, size + 1);

    if (memory == NULL) {
        serving_end(1);
    }
    return memory;
}

size_t serving_take_size(void) {
    return packet_take_size(&served.in);
}

void *serving_take_copy(size_t *size) {
    uint64_t count;

    TAKE(&served.in, count);
    const char *bytes = packet_see(&served.in, (size_t)count);
    *size = bytes == NULL ? 0 : (size_t)count;
    return *size == 0 ? NULL : memcpy(serving_memory(NULL, *size), bytes, *size);
}

char *serving_copy(const char *text) {
    const size_t size = strlen(text) + 1;
    return memcpy(serving_memory(NULL, size), text, size);
}

void serving_answer(Status status) {
    const int32_t number = status;

    floats_restore_if_seen(&served.floats);
    packet_clear(&served.out);
    PUT(&served.out, number);
}
