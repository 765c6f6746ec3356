/* Messages over the standard streams. */

#include "frames.h"

#define WIN32_LEAN_AND_MEAN
#include <fcntl.h>
#include <io.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <windows.h>

enum {
    LONGEST_WATCH = 40000, /* ns before this process goes to sleep; as in channel.py */
    PAUSES = 16            /* looks before others may have the processor */
};

static HANDLE input, output;
static const Atomic *watched; /* NULL before frames_watch */
static uint64_t heard;        /* messages received, in the numbers of the watched count */

static HANDLE copy_of(DWORD stream) {
    HANDLE copy = NULL;
    const HANDLE process = GetCurrentProcess();

    DuplicateHandle(process, GetStdHandle(stream), process, &copy, 0, FALSE, DUPLICATE_SAME_ACCESS);
    return copy;
}

bool frames_open(void) {
    input = copy_of(STD_INPUT_HANDLE);
    output = copy_of(STD_OUTPUT_HANDLE);
    const int nothing = _open("NUL", _O_RDONLY);
    _dup2(2, 1);
    _dup2(nothing, 0);
    setvbuf(stdout, NULL, _IONBF, 0); /* the next call may end the process */
    /* libraries with a C library of their own look these up */
    SetStdHandle(STD_OUTPUT_HANDLE, GetStdHandle(STD_ERROR_HANDLE));
    SetStdHandle(STD_INPUT_HANDLE, (HANDLE)_get_osfhandle(nothing));
    return input != NULL && output != NULL;
}

static bool receive(char *bytes, size_t size) {
    while (size > 0) {
        const DWORD wanted = size > 1 << 20 ? 1 << 20 : (DWORD)size;
        DWORD received = 0;
        if (!ReadFile(input, bytes, wanted, &received, NULL) || received == 0) {
            return false;
        }
        bytes += received;
        size -= received;
    }
    return true;
}

static bool send(const char *bytes, size_t size) {
    while (size > 0) {
        const DWORD wanted = size > 1 << 20 ? 1 << 20 : (DWORD)size;
        DWORD sent = 0;
        if (!WriteFile(output, bytes, wanted, &sent, NULL) || sent == 0) {
            return false;
        }
        bytes += sent;
        size -= sent;
    }
    return true;
}

void frames_watch(const Atomic *bell) {
    watched = bell;
    heard = atomic_get(bell);
}

static bool is_announced(void) {
    for (int i = 0; i < PAUSES; i++) {
        if (atomic_get(watched) > heard) {
            return true;
        }
        spin_pause();
    }
    return false;
}

/* Waking a process on an idle processor takes tens of microseconds. A read from a stream cannot
 * wait any other way, and asking Wine whether it would takes about as long. */
static void wait_for_message(void) {
    const uint64_t deadline = clock_now() + LONGEST_WATCH;

    while (!is_announced() && clock_now() < deadline) {
        SwitchToThread();
    }
}

bool receive_code(char *code) {
    if (watched != NULL) {
        wait_for_message();
    }
    heard++;
    return receive(code, 1);
}

bool receive_content(char **bytes, size_t *size) {
    uint64_t length = 0;

    *bytes = NULL;
    if (!receive((char *)&length, sizeof length)) {
        return false;
    }
    *size = (size_t)length;
    *bytes = malloc(*size + 1);
    return *bytes != NULL && receive(*bytes, *size);
}

bool send_code(char code) {
    return send(&code, 1);
}

bool send_content(char code, const void *bytes, size_t size) {
    const uint64_t length = size;
    char head[1 + sizeof length] = {code};

    memcpy(head + 1, &length, sizeof length);
    return send(head, sizeof head) && send(bytes, size);
}

/* Reading */

const char *read_bytes(Reader *reader, size_t count) {
    const char *bytes = reader->at;

    if (!reader->sound || count > (size_t)(reader->end - reader->at)) {
        reader->sound = false;
        return NULL;
    }
    reader->at += count;
    return bytes;
}

static void read_into(Reader *reader, void *value, size_t size) {
    const char *bytes = read_bytes(reader, size);

    if (bytes == NULL) {
        memset(value, 0, size);
    } else {
        memcpy(value, bytes, size);
    }
}

uint8_t read_flag(Reader *reader) {
    uint8_t flag;
    read_into(reader, &flag, sizeof flag);
    return flag;
}

int64_t read_integer(Reader *reader) {
    int64_t number;
    read_into(reader, &number, sizeof number);
    return number;
}

double read_number(Reader *reader) {
    double number;
    read_into(reader, &number, sizeof number);
    return number;
}

const char *read_block(Reader *reader, size_t *size) {
    *size = (size_t)read_integer(reader);
    const char *bytes = read_bytes(reader, *size);
    *size = bytes == NULL ? 0 : *size;
    return bytes;
}

const char *read_text(Reader *reader) {
    size_t size;
    const char *text = read_block(reader, &size);
    const char *end = read_bytes(reader, 1);

    if (end == NULL || *end != '\0') {
        reader->sound = false;
        return "";
    }
    return text;
}

/* Writing */

void *memory_for(void *old, size_t size) {
    void *memory = realloc(old, size + 1);

    if (memory == NULL) {
        fprintf(stderr, "the worker has no memory left\n");
        ExitProcess(1);
    }
    return memory;
}

void write_bytes(Writer *writer, const void *bytes, size_t count) {
    if (writer->size + count > writer->room) {
        writer->room = 2 * (writer->size + count);
        writer->bytes = memory_for(writer->bytes, writer->room);
    }
    if (count > 0) {
        memcpy(writer->bytes + writer->size, bytes, count);
        writer->size += count;
    }
}

void write_integer(Writer *writer, int64_t number) {
    write_bytes(writer, &number, sizeof number);
}

void write_number(Writer *writer, double number) {
    write_bytes(writer, &number, sizeof number);
}

void write_block(Writer *writer, const void *bytes, size_t size) {
    write_integer(writer, (int64_t)size);
    write_bytes(writer, bytes, size);
}

void write_text(Writer *writer, const char *text) {
    write_block(writer, text, text == NULL ? 0 : strlen(text));
}
