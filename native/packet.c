#include "packet.h"

#include <stdlib.h>
#include <string.h>

void packet_clear(Packet *packet) {
    packet->sound = true;
    packet->at = PACKET_HEAD;
    packet_resize(packet, PACKET_HEAD);
}

void packet_free(Packet *packet) {
    free(packet->bytes);
    *packet = (Packet){.sound = false};
}

bool packet_resize(Packet *packet, size_t size) {
    if (size > packet->room) {
        char *bytes = realloc(packet->bytes, 2 * size);
        if (bytes == NULL) {
            packet->sound = false;
            return false;
        }
        packet->bytes = bytes;
        packet->room = 2 * size;
    }
    packet->size = size;
    return true;
}

void packet_put(Packet *packet, const void *bytes, size_t size) {
    const size_t begin = packet->size;

    if (packet->sound && size > 0 && packet_resize(packet, begin + size)) {
        memcpy(packet->bytes + begin, bytes, size);
    }
}

void packet_put_text(Packet *packet, const char *text) {
    packet_put_block(packet, text == NULL ? "" : text, strlen(text == NULL ? "" : text) + 1);
}

void packet_put_size(Packet *packet, size_t size) {
    const uint64_t number = size;
    PUT(packet, number);
}

void packet_put_block(Packet *packet, const void *bytes, size_t size) {
    packet_put_size(packet, bytes == NULL ? 0 : size);
    packet_put(packet, bytes, bytes == NULL ? 0 : size);
}

const char *packet_see(Packet *packet, size_t size) {
    if (!packet->sound || size > packet->size - packet->at) {
        packet->sound = false;
        return NULL;
    }
    packet->at += size;
    return packet->bytes + packet->at - size;
}

void packet_take(Packet *packet, void *bytes, size_t size) {
    const char *place = packet_see(packet, size);

    if (place == NULL) {
        memset(bytes, 0, size);
    } else if (size > 0) {
        memcpy(bytes, place, size);
    }
}

size_t packet_take_size(Packet *packet) {
    uint64_t size;

    TAKE(packet, size);
    return (size_t)size;
}

const char *packet_take_text(Packet *packet) {
    const size_t size = packet_take_size(packet);
    const char *text = packet_see(packet, size);
    if (text == NULL || size == 0 || text[size - 1] != '\0') {
        packet->sound = false;
        return "";
    }
    return text;
}
