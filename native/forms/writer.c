/* Writer of forms. */

#include "forms/writer.h"

#include <stdlib.h>
#include <string.h>

static char *grow(Writer *writer, size_t size) {
    const size_t begin = writer->size, whole = size + (8 - size % 8) % 8;

    if (begin + whole > writer->room) {
        const size_t room = 2 * (begin + whole);
        char *bytes = realloc(writer->bytes, room);
        if (bytes == NULL) {
            writer->failed = true;
            return NULL;
        }
        writer->bytes = bytes;
        writer->room = room;
    }
    writer->size += whole;
    memset(writer->bytes + begin + size, 0, whole - size);
    return writer->bytes + begin;
}

static void put(Writer *writer, const void *bytes, size_t size) {
    char *room = grow(writer, size);

    if (room != NULL && size > 0) {
        memcpy(room, bytes, size);
    }
}

void write_integer(Writer *writer, int64_t number) {
    put(writer, &number, sizeof number);
}

void write_number(Writer *writer, double number) {
    put(writer, &number, sizeof number);
}

char *write_room(Writer *writer, size_t size) {
    write_integer(writer, (int64_t)size);
    return grow(writer, size);
}

void write_block(Writer *writer, const void *bytes, size_t size) {
    write_integer(writer, (int64_t)size);
    put(writer, bytes, size);
}

void write_text(Writer *writer, const char *text) {
    write_block(writer, text == NULL ? "" : text, text == NULL ? 1 : strlen(text) + 1);
}
