/* Records of start values and inputs, by which episodes are played again. */

#include "pool/recorded_inputs.h"

#include <stdlib.h>
#include <string.h>

static const size_t RECORDS_LIMIT = (size_t)256 << 20; /* total bytes of one pool's records */

static const size_t NOT_WHOLE = SIZE_MAX;

enum {
    FIRST_ROWS = 32, /* of the first block; each later one has as many as all before it together */
    BLOCKS = 24      /* more than the limit allows */
};

typedef struct {
    RecordedStart *values;
    size_t count;
    char *texts; /* of the Strings among them, in their order */
    size_t size; /* of the texts */
} Starts;

/* A row has the inputs of a step of all instances. Each counts the steps of its own episode, but most
 * neighbours are at the same one. So a run of instances writes to one place in memory instead of one
 * for each instance, which takes several times as long. */
struct Records {
    size_t count, width;
    Starts *starts; /* of each instance */
    size_t *rows;   /* the steps of each instance, or NOT_WHOLE */
    Atomic blocks[BLOCKS]; /* addresses of rows */
};

static Records *make_records(size_t count, size_t width) {
    Records *r = calloc(1, sizeof *r);

    if (r != NULL) {
        r->count = count;
        r->width = width;
        r->starts = calloc(count, sizeof *r->starts);
        r->rows = malloc(count * sizeof *r->rows);
    }
    return r;
}

static void free_records(Records *r) {
    for (size_t i = 0; i < r->count && r->starts != NULL; i++) {
        free(r->starts[i].values);
        free(r->starts[i].texts);
    }
    for (size_t k = 0; k < BLOCKS; k++) {
        free((void *)(uintptr_t)atomic_get(&r->blocks[k]));
    }
    free(r->starts);
    free(r->rows);
    free(r);
}

bool records_open(Pool *pool) {
    const size_t count = pool->settings.count;

    Records *r = make_records(count, pool->settings.inputs->count);
    if (r != NULL && (r->starts == NULL || r->rows == NULL)) {
        free_records(r);
        r = NULL;
    }
    for (size_t i = 0; r != NULL && i < count; i++) {
        r->rows[i] = NOT_WHOLE;
    }
    pool->records = r;
    return r != NULL;
}

void records_close(Pool *pool) {
    if (pool->records != NULL) {
        free_records(pool->records);
        pool->records = NULL;
    }
}

static void note_starts(RecordedStart *values, const Access *start, const double *starts) {
    for (size_t i = 0; i < start->count; i++) {
        const Element *variable = &start->variables[i];
        const char *text = access_text(start, i, starts[i]);
        const bool is_string = start->types[i] == TYPE_STRING;
        values[i] = (RecordedStart){is_string ? 0.0 : starts[i], start->types[i],
                                    variable->reference, variable->place,
                                    text == NULL ? 0 : (uint32_t)strlen(text) + 1};
    }
}

static void note_texts(const RecordedStart *values, const Access *start, const double *starts,
                       char *to) {
    for (size_t i = 0; i < start->count; to += values[i].size, i++) {
        if (values[i].size > 0) {
            memcpy(to, access_text(start, i, starts[i]), values[i].size);
        }
    }
}

/* The memory for the start values of an instance; NULL if there is none. */
static RecordedStart *room_for_starts(Records *r, size_t index, size_t count) {
    Starts *own = &r->starts[index];

    if (own->count != count || own->values == NULL) {
        free(own->values);
        own->values = calloc(count + 1, sizeof *own->values);
        own->count = count;
    }
    r->rows[index] = own->values == NULL ? NOT_WHOLE : 0;
    return own->values;
}

/* The memory for the texts of an instance, whose sizes its start values tell; NULL if there is none. */
static char *room_for_texts(Records *r, size_t index) {
    Starts *own = &r->starts[index];
    size_t size = 0;

    for (size_t i = 0; i < own->count; i++) {
        size += own->values[i].size;
    }
    if (own->size != size || own->texts == NULL) {
        free(own->texts);
        own->texts = malloc(size + 1);
        own->size = size;
    }
    r->rows[index] = own->texts == NULL ? NOT_WHOLE : r->rows[index];
    return own->texts;
}

void record_begin(Pool *pool, size_t index, const Access *start, const double *starts) {
    if (pool->records == NULL) {
        return;
    }
    RecordedStart *values = room_for_starts(pool->records, index, start->count);
    if (values == NULL) {
        return;
    }
    note_starts(values, start, starts);
    char *texts = room_for_texts(pool->records, index);
    if (texts != NULL) {
        note_texts(values, start, starts, texts);
    }
}

/* Threads may need a new block at the same time. Then one of them makes it for all. */
static double *block_of(Records *r, size_t block, size_t rows) {
    uint64_t known = atomic_get(&r->blocks[block]);

    if (known != 0) {
        return (double *)(uintptr_t)known;
    }
    double *made = malloc(rows * r->count * r->width * sizeof *made + 1);
    if (made == NULL || atomic_replace(&r->blocks[block], &known, (uintptr_t)made)) {
        return made;
    }
    free(made);
    return (double *)(uintptr_t)known;
}

/* Returns NULL if there is no memory for it. */
static double *row_of(Records *r, size_t row) {
    size_t block = 0, end = FIRST_ROWS;

    for (; row >= end; block++) {
        end *= 2;
    }
    if (end * (r->width + 1) * r->count > RECORDS_LIMIT / sizeof(double)) {
        return NULL;
    }
    const size_t first = block == 0 ? 0 : end / 2;
    double *inputs = block_of(r, block, end - first);
    return inputs == NULL ? NULL : inputs + (row - first) * r->count * r->width;
}

/* The instances have done the same number of steps. */
static void add_to_row(Records *r, size_t begin, size_t end, const double *inputs) {
    double *row = row_of(r, r->rows[begin]);
    const size_t rows = row == NULL ? NOT_WHOLE : r->rows[begin] + 1;

    if (row != NULL && r->width > 0) {
        memcpy(row + begin * r->width, inputs, (end - begin) * r->width * sizeof *inputs);
    }
    for (size_t i = begin; i < end; i++) {
        r->rows[i] = rows;
    }
}

void records_add(Pool *pool, size_t begin, size_t count, Mask mask, const double *inputs) {
    Records *r = pool->records;
    size_t next;

    for (size_t i = begin; r != NULL && i < begin + count; i = next) {
        const size_t rows = is_in(mask, i) ? NOT_WHOLE : r->rows[i];
        next = i + 1;
        if (rows == NOT_WHOLE) {
            continue;
        }
        while (next < begin + count && r->rows[next] == rows && !is_in(mask, next)) {
            next++;
        }
        add_to_row(r, i, next, inputs + (i - begin) * r->width);
    }
}

void record_drop(Pool *pool, size_t index) {
    if (pool->records != NULL) {
        pool->records->rows[index] = NOT_WHOLE;
    }
}

bool record_is_whole(const Pool *pool, size_t index) {
    return pool->records != NULL && pool->records->rows[index] != NOT_WHOLE;
}

size_t record_size(const Pool *pool, size_t index, int64_t *starts, int64_t *rows) {
    const Records *r = pool->records;

    *starts = (int64_t)r->starts[index].count;
    *rows = (int64_t)r->rows[index];
    return r->starts[index].count * sizeof(RecordedStart) + r->starts[index].size +
           r->rows[index] * r->width * sizeof(double);
}

void record_write(const Pool *pool, size_t index, char *to) {
    Records *r = pool->records;
    const size_t size = r->starts[index].count * sizeof(RecordedStart);
    const size_t row_size = r->width * sizeof(double);

    memcpy(to, r->starts[index].values, size);
    to += size;
    memcpy(to, r->starts[index].texts, r->starts[index].size);
    to += r->starts[index].size;
    for (size_t row = 0; row < r->rows[index] && row_size > 0; row++, to += row_size) {
        memcpy(to, row_of(r, row) + index * r->width, row_size);
    }
}

bool record_fits(const Pool *pool, int64_t starts, int64_t rows, const char *bytes, size_t size) {
    const Records *r = pool->records;

    if (r == NULL || starts < 0 || (uint64_t)starts > size / sizeof(RecordedStart) || rows < 0) {
        return false;
    }
    size_t rest = size - (size_t)starts * sizeof(RecordedStart);
    const size_t row_size = r->width * sizeof(double);
    for (int64_t i = 0; i < starts; i++, bytes += sizeof(RecordedStart)) {
        RecordedStart one;
        memcpy(&one, bytes, sizeof one);
        if (one.size > rest) {
            return false;
        }
        rest -= one.size;
    }
    return row_size == 0 ? rest == 0 : rest % row_size == 0 && (uint64_t)rows == rest / row_size;
}

void record_put(Pool *pool, size_t index, size_t starts, size_t rows, const char *from) {
    Records *r = pool->records;
    RecordedStart *values = room_for_starts(r, index, starts);
    const size_t row_size = r->width * sizeof(double);

    if (values == NULL) {
        return;
    }
    memcpy(values, from, starts * sizeof *values);
    from += starts * sizeof *values;
    char *texts = room_for_texts(r, index);
    if (texts == NULL) {
        return;
    }
    memcpy(texts, from, r->starts[index].size);
    from += r->starts[index].size;
    for (size_t row = 0; row < rows; row++, from += row_size) {
        double *to = row_of(r, row);
        if (to == NULL) {
            record_drop(pool, index);
            return;
        }
        memcpy(to + index * r->width, from, row_size);
    }
    r->rows[index] = rows;
}
