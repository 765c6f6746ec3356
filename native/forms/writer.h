/* A form that grows: see form.h. */

#ifndef FMUGYM_WRITER_H
#define FMUGYM_WRITER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef struct {
    char *bytes; /* the caller frees them */
    size_t size, room;
    bool failed; /* whether memory has run out, so that something is missing */
} Writer;

void write_integer(Writer *writer, int64_t number);
void write_number(Writer *writer, double number);
void write_text(Writer *writer, const char *text); /* NULL counts as empty */
void write_block(Writer *writer, const void *bytes, size_t size);
/* Makes room for a block, which the caller fills. It stays there until the next call. Returns NULL if
 * memory runs out. */
char *write_room(Writer *writer, size_t size);

#endif
