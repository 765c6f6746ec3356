/* The bytes of a message between two processes of one machine. What was put in is taken out in the
 * same order. */

#ifndef FMUGYM_PACKET_H
#define FMUGYM_PACKET_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* A message begins with a code of one byte and the number of bytes that follow. */
enum { PACKET_HEAD = 1 + sizeof(uint64_t) };

typedef struct {
    char *bytes; /* the head and the content */
    size_t size, room;
    size_t at;  /* what has been taken so far */
    bool sound; /* false after memory ran out, or more was taken than there was */
} Packet;

/* Begins a new message. */
void packet_clear(Packet *packet);
void packet_free(Packet *packet);
/* Lets the packet have so many bytes. Returns whether there was enough memory. */
bool packet_resize(Packet *packet, size_t size);

void packet_put(Packet *packet, const void *bytes, size_t size);
/* NULL counts as an empty text. */
void packet_put_text(Packet *packet, const char *text);
void packet_put_size(Packet *packet, size_t size);
/* The size and so many bytes; NULL counts as none. */
void packet_put_block(Packet *packet, const void *bytes, size_t size);

/* Fills the memory with zeros if there is not enough to take. */
void packet_take(Packet *packet, void *bytes, size_t size);
size_t packet_take_size(Packet *packet);
/* Both return a place in the packet, which the next message overwrites; NULL, or an empty text, if
 * there is not enough to take. */
const char *packet_see(Packet *packet, size_t size);
const char *packet_take_text(Packet *packet);

#define PUT(packet, value) packet_put((packet), &(value), sizeof(value))
#define TAKE(packet, value) packet_take((packet), &(value), sizeof(value))

#endif
