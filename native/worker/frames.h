/* Messages between the worker and the process that has started it.
 *
 * A message is a code of one byte, or a code, a length of 8 bytes and so many bytes. Numbers in it
 * are little-endian: integers and floating-point numbers of 8 bytes. fmugym/pool/process/windows.py
 * is the other end. */

#ifndef FMUGYM_FRAMES_H
#define FMUGYM_FRAMES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "../platform.h"

/* The codes are those of fmugym/pool/process/channel.py. */
enum {
    CODE_STEP = 's',
    CODE_STEP_SOME = 'k',
    CODE_REQUEST = 'r',
    CODE_RELEASE = 'f',
    CODE_FINE = 'F',
    CODE_TROUBLE = 'T',
    CODE_RESULT = 'R',
    CODE_ERROR = 'E',
    CODE_LOG = 'L',
    CODE_FAULT = 'X'
};

/* Keeps the standard streams for messages; what the FMU prints goes to the standard error. */
bool frames_open(void);

/* A count in shared memory that the other end raises after each message. From now on receive_code
 * watches it for a short time before it goes to sleep. */
void frames_watch(const Atomic *bell);

/* Return whether it worked; the other end may be gone. */
bool receive_code(char *code);
bool receive_content(char **bytes, size_t *size); /* the caller frees the bytes */
bool send_code(char code);
bool send_content(char code, const void *bytes, size_t size);

/* Reads the content of a message. What is missing reads as 0, and sound becomes false. */
typedef struct {
    const char *at, *end;
    bool sound;
} Reader;

const char *read_bytes(Reader *reader, size_t count);
uint8_t read_flag(Reader *reader);
int64_t read_integer(Reader *reader);
double read_number(Reader *reader);
/* A length, so many bytes, and a zero; the text lives as long as the content. */
const char *read_text(Reader *reader);
/* A length and so many bytes. */
const char *read_block(Reader *reader, size_t *size);

/* As realloc; if memory runs out, the process ends, which its parent takes as a death. */
void *memory_for(void *old, size_t size);

/* Bytes that grow; the caller frees them. */
typedef struct {
    char *bytes;
    size_t size, room;
} Writer;

void write_bytes(Writer *writer, const void *bytes, size_t count);
void write_integer(Writer *writer, int64_t number);
void write_number(Writer *writer, double number);
void write_text(Writer *writer, const char *text); /* NULL counts as empty */
void write_block(Writer *writer, const void *bytes, size_t size);

#endif
