#include "texts.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "platform.h"

enum { BITS = 53, FIRST_ROOM = 64 };

static const size_t MOST_TEXTS = (size_t)1 << 20;

static Mutex lock = MUTEX_INITIALIZER;
static Text *table; /* with open addressing; places without a text are free */
static size_t room, count;

/* FNV-1a for 64 bits, folded to as many bits as a double holds exactly. */
static uint64_t hash_of(const char *text) {
    uint64_t hash = 0xCBF29CE484222325u;

    for (; *text != 0; text++) {
        hash = (hash ^ (uint8_t)*text) * 0x100000001B3u;
    }
    return (hash >> BITS) ^ (hash & (((uint64_t)1 << BITS) - 1));
}

/* The place of a number, or the free one where it belongs. */
static Text *place_of(Text *places, size_t size, double number) {
    size_t i = (size_t)((uint64_t)number % size);

    while (places[i].text != NULL && places[i].number != number) {
        i = (i + 1) % size;
    }
    return &places[i];
}

static bool make_room(void) {
    if (2 * count < room) {
        return true;
    }
    const size_t wanted = room == 0 ? FIRST_ROOM : 2 * room;
    Text *larger = count >= MOST_TEXTS ? NULL : calloc(wanted, sizeof *larger);
    if (larger == NULL) {
        return false;
    }
    for (size_t i = 0; i < room; i++) {
        if (table[i].text != NULL) {
            *place_of(larger, wanted, table[i].number) = table[i];
        }
    }
    free(table);
    table = larger;
    room = wanted;
    return true;
}

static double keep(const char *text, double number) {
    Text *place = place_of(table, room, number);

    if (place->text == NULL) {
        const size_t size = strlen(text) + 1;
        char *copy = malloc(size);
        if (copy == NULL) {
            return -1.0;
        }
        memcpy(copy, text, size);
        *place = (Text){number, copy};
        count++;
    }
    return strcmp(place->text, text) == 0 ? number : -1.0;
}

double text_number(const char *text) {
    const char *given = text == NULL ? "" : text;
    const double number = (double)hash_of(given);

    mutex_lock(&lock);
    const double found = make_room() ? keep(given, number) : -1.0;
    mutex_unlock(&lock);
    return found;
}

void texts_before_fork(void) {
    mutex_lock(&lock);
}

void texts_after_fork_in_parent(void) {
    mutex_unlock(&lock);
}

void texts_after_fork_in_child(void) {
    mutex_reset(&lock);
}

const char *text_with(double number) {
    const bool may_be_one = number >= 0.0 && number < (double)((uint64_t)1 << BITS);

    mutex_lock(&lock);
    const char *found = may_be_one && room > 0 ? place_of(table, room, number)->text : NULL;
    mutex_unlock(&lock);
    return found;
}
