#include "records.h"

#include <stdlib.h>
#include <string.h>

static const size_t RECORDS_LIMIT = (size_t)256 << 20; /* total bytes of one pool's records */

enum { FIRST_ROOM = 32 };

bool records_open(Pool *pool) {
    if (pool->records == NULL) {
        pool->records = calloc(pool->settings.count, sizeof *pool->records);
    }
    return pool->records != NULL;
}

void records_close(Pool *pool) {
    for (size_t i = 0; i < pool->settings.count && pool->records != NULL; i++) {
        free(pool->records[i].starts);
        free(pool->records[i].inputs);
    }
    free(pool->records);
    pool->records = NULL;
}

static void note_starts(Record *record, const Access *start, const double *starts) {
    for (size_t i = 0; i < start->count; i++) {
        const Element *variable = &start->variables[i];
        record->starts[i] = (RecordedStart){starts[i], start->types[i], variable->reference,
                                            variable->place};
    }
}

void record_begin(Pool *pool, size_t index, const Access *start, const double *starts) {
    if (pool->records == NULL) {
        return;
    }
    Record *record = &pool->records[index];
    record->rows = 0;
    record->whole = true;
    if (record->number_of_starts != start->count || record->starts == NULL) {
        free(record->starts);
        record->starts = calloc(start->count + 1, sizeof *record->starts);
        record->number_of_starts = start->count;
        record->whole = record->starts != NULL;
    }
    if (record->whole) {
        note_starts(record, start, starts);
    }
}

static bool make_room(const Pool *pool, Record *record) {
    const size_t width = pool->settings.inputs->count + 1;
    const size_t room = record->room == 0 ? FIRST_ROOM : 2 * record->room;

    if (record->rows < record->room) {
        return true;
    }
    if (room * width > RECORDS_LIMIT / sizeof(double) / pool->settings.count) {
        return false;
    }
    double *inputs = realloc(record->inputs, room * width * sizeof *inputs);
    if (inputs != NULL) {
        record->inputs = inputs;
        record->room = room;
    }
    return inputs != NULL;
}

void record_add(Pool *pool, size_t index, const double *inputs) {
    const size_t width = pool->settings.inputs->count;

    if (pool->records == NULL || !pool->records[index].whole) {
        return;
    }
    Record *record = &pool->records[index];
    record->whole = make_room(pool, record);
    if (record->whole) {
        memcpy(record->inputs + record->rows * width, inputs, width * sizeof *inputs);
        record->rows++;
    }
}

void record_drop(Pool *pool, size_t index) {
    if (pool->records != NULL) {
        pool->records[index].whole = false;
    }
}
