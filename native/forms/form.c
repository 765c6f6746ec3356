/* Reader of forms. A form is numbers, texts, arrays and variables as bytes; each read is checked. */

#include "forms/form.h"

#include <stdlib.h>
#include <string.h>

const char form_truncated[] = "it ends too early, or is too long";
const char form_no_memory[] = "out of memory";

/* Reading */

bool reader_refuse(Reader *reader, const char *fault) {
    reader->fault = reader->fault == NULL ? fault : reader->fault;
    return false;
}

bool reader_require(Reader *reader, bool holds, const char *fault) {
    return holds ? reader->fault == NULL : reader_refuse(reader, fault);
}

static const char *read_bytes(Reader *reader, uint64_t size) {
    const char *bytes = reader->at;
    const uint64_t left = (uint64_t)(reader->end - reader->at);
    const uint64_t whole = size + (8 - size % 8) % 8;

    if (reader->fault != NULL || size > left || whole > left) {
        reader_refuse(reader, form_truncated);
        return NULL;
    }
    reader->at += whole;
    return bytes;
}

int64_t read_integer(Reader *reader) {
    const char *bytes = read_bytes(reader, sizeof(int64_t));
    int64_t number = 0;

    if (bytes != NULL) {
        memcpy(&number, bytes, sizeof number);
    }
    return number;
}

int64_t read_integer_in(Reader *reader, int64_t lowest, int64_t highest) {
    const int64_t number = read_integer(reader);
    const bool fits = number >= lowest && number <= highest;
    return reader_require(reader, fits, "a number is out of range") ? number : lowest;
}

bool read_flag(Reader *reader) {
    return read_integer_in(reader, 0, 1) != 0;
}

double read_number(Reader *reader) {
    const int64_t bits = read_integer(reader);
    double number;
    memcpy(&number, &bits, sizeof number);
    return number;
}

Block read_block(Reader *reader) {
    const uint64_t size = (uint64_t)read_integer(reader);
    const char *bytes = read_bytes(reader, size);
    return (Block){bytes, bytes == NULL ? 0 : (size_t)size};
}

const void *read_array(Reader *reader, size_t size, size_t *count) {
    const Block block = read_block(reader);

    *count = reader_require(reader, block.size % size == 0, "an array has a part of a value")
                 ? block.size / size
                 : 0;
    return block.bytes;
}

const void *read_values(Reader *reader, size_t size, size_t wanted, const char *fault) {
    size_t count;
    const void *values = read_array(reader, size, &count);
    return reader_require(reader, count == wanted, fault) ? values : NULL;
}

const char *read_text(Reader *reader) {
    const Block block = read_block(reader);
    const bool ends = block.size > 0 && block.bytes[block.size - 1] == '\0';
    return reader_require(reader, ends, "a text does not end") ? block.bytes : "";
}

size_t read_count(Reader *reader) {
    return (size_t)read_integer_in(reader, 0, (reader->end - reader->at) / 8);
}

void *reader_room(Reader *reader, size_t count, size_t size) {
    void *memory = calloc(count + 1, size);
    reader_require(reader, memory != NULL, form_no_memory);
    return memory;
}

const char **read_texts(Reader *reader, size_t *count) {
    *count = read_count(reader);
    const char **texts = reader_room(reader, *count, sizeof *texts);

    for (size_t i = 0; texts != NULL && i < *count; i++) {
        texts[i] = read_text(reader);
    }
    if (reader->fault != NULL) {
        free((void *)texts);
        *count = 0;
        return NULL;
    }
    return texts;
}

const Fmi *read_fmi(Reader *reader) {
    const int64_t version = read_integer(reader), manner = read_integer(reader);
    const Fmi *fmi = reader->fault == NULL ? fmi_table(version, manner) : NULL;

    reader_require(reader, fmi != NULL, "there is no such FMI version");
    return fmi;
}

bool read_access(Reader *reader, const Fmi *fmi, Access *access) {
    const Block types = read_block(reader), elements = read_block(reader);
    const Block rest = read_block(reader), counts = read_block(reader);
    const Block texts = read_block(reader);
    Listing listing;

    memset(access, 0, sizeof *access);
    if (reader->fault != NULL) {
        return false;
    }
    const char *fault = listing_take(&listing, types, elements, rest, counts, texts);
    if (fault != NULL) {
        return reader_refuse(reader, fault);
    }
    return reader_require(reader, access_open(access, fmi, &listing), form_no_memory) &&
           reader_require(reader, access_is_sound(access), "the elements of an array differ in its size");
}

char *form_copy(const void *form, size_t size) {
    char *copy = malloc(size + 1);

    if (copy != NULL && size > 0) {
        memcpy(copy, form, size);
    }
    return copy;
}
