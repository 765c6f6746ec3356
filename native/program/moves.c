/* Instructions of programs that load and store rows. */

#include "program/operations.h"

#include <float.h>
#include <math.h>
#include <string.h>

#include "fmi/fmi.h"
#include "shared/platform.h"

#define EACH_ITEM(size, type)                                                                      \
    case size: {                                                                                   \
        type *restrict into = to;                                                                  \
        const type *restrict out = (const type *)from;                                             \
        UNROLLED                                                                                   \
        for (size_t j = 0; j < count; j++) {                                                       \
            into[j * to_step] = out[j * from_step];                                                \
        }                                                                                          \
        break;                                                                                     \
    }

/* Copies count values of size bytes each. The steps are in values. */
static void copy_values(void *to, size_t to_step, const void *from, size_t from_step, size_t count,
                        size_t size) {
    if (to_step == 1 && from_step == 1) {
        memcpy(to, from, count * size);
        return;
    }
    switch (size) {
        EACH_ITEM(8, uint64_t)
        EACH_ITEM(4, uint32_t)
        EACH_ITEM(1, uint8_t)
    }
}

/* Returns where whole blocks of the values lie: at their own place if they follow each other there,
 * otherwise in a register, to which it copies them. */
static const void *loaded(const Evaluation *e, const char *from, size_t step, size_t size,
                          Register *to) {
    if (step == 1 && e->count == e->lanes) {
        return from;
    }
    copy_values(to, 1, from, step, e->count, size);
    clear_rest(to, e->count, e->lanes, size);
    return to;
}

static char *place_in(const Evaluation *e, const Row *row) {
    return row_begin(row, e->source->arrays) + e->begin * row->stride * row->size;
}

static const void *load_row(const Evaluation *e, const Row *row, Register *to) {
    const char *from = place_in(e, row);

    if (row->changes) { /* a later STORE_ROW must not change what was loaded */
        copy_values(to, 1, from, row->stride, e->count, row->size);
        clear_rest(to, e->count, e->lanes, row->size);
        return to;
    }
    return loaded(e, from, row->stride, row->size, to);
}

WIDE static void find_failed(const int8_t *statuses, size_t count, uint8_t *restrict to) {
    for (size_t j = 0; j < count; j++) {
        to[j] = (statuses[j] > STATUS_WARNING) & (statuses[j] != STATUS_TERMINATED);
    }
}

WIDE static void find_stopped(const int8_t *statuses, size_t count, uint8_t *restrict to) {
    for (size_t j = 0; j < count; j++) {
        to[j] = statuses[j] == STATUS_TERMINATED;
    }
}

static void load_flag(const Evaluation *e, uint16_t operation, uint8_t *to) {
    memset(to, 0, e->lanes);
    if (e->source->statuses != NULL && operation == LOAD_FAILED) {
        find_failed(e->source->statuses + e->begin, e->count, to);
    } else if (e->source->statuses != NULL) {
        find_stopped(e->source->statuses + e->begin, e->count, to);
    }
}

/* The first loop looks whether there is any such value; nearly always there is none. */
#define NOTE_NOT_FINITE(Type, name, Whole, absolute, most)                                         \
    WIDE static void name(const Type *values, size_t count, Notes *notes) {                        \
        Whole any = 0; /* as wide as the values, so that the compiler can vectorize */             \
        for (size_t j = 0; j < count; j++) {                                                       \
            any |= !(absolute(values[j]) <= most);                                                 \
        }                                                                                          \
        for (size_t j = 0; any != 0 && j < count; j++) {                                           \
            notes->not_finite[j] |= !(absolute(values[j]) <= most);                                \
        }                                                                                          \
    }

NOTE_NOT_FINITE(double, note_not_finite, int64_t, fabs, DBL_MAX)
NOTE_NOT_FINITE(float, note_not_finite32, int32_t, fabsf, FLT_MAX)

static void store_row(const Evaluation *e, const Row *row, const void *values) {
    copy_values(place_in(e, row), row->stride, values, 1, e->count, row->size);
    if (row->data != NULL) {
        return;
    }
    if (row->type == VALUE_DOUBLE) {
        note_not_finite(values, e->count, e->notes);
    } else if (row->type == VALUE_FLOAT) {
        note_not_finite32(values, e->count, e->notes);
    }
}

WIDE static void convert(const double *restrict values, size_t count, float *restrict to) {
    for (size_t k = 0; k < count; k++) {
        to[k] = (float)values[k];
    }
}

WIDE static void convert_lines(const double *restrict values, size_t step, size_t lines,
                               size_t number, float *restrict to, size_t to_step) {
    for (size_t j = 0; j < lines; j++, values += step, to += to_step) {
        UNROLLED
        for (size_t k = 0; k < number; k++) {
            to[k] = (float)values[k];
        }
    }
}

/* Stores outputs of which each environment's follow each other. All of them are finite as floats. */
static void store_fresh(const Evaluation *e, const Row *to, size_t output, size_t number) {
    const Fresh *fresh = e->source->fresh;

    convert_lines(fresh->lines + output, fresh->width, e->count, number,
                  (float *)(void *)place_in(e, to), to->stride);
}

/* Whether rows are those of outputs that follow each other. */
static bool are_neighbours(const Row *rows, size_t number) {
    bool are = rows->output > 0;

    for (size_t k = 1; k < number; k++) {
        are &= rows[k].output == rows->output + k;
    }
    return are;
}

/* Stores rows of doubles as floats in neighbouring elements. */
static void store_floats(const Evaluation *e, const Row *from, const Row *to, size_t number) {
    const Fresh *fresh = e->source->fresh;
    Register doubles, floats;

    if (fresh != NULL && fresh->fits_floats && are_neighbours(from, number)) {
        store_fresh(e, to, from->output - 1, number);
        return;
    }
    for (size_t k = 0; k < number; k++) {
        convert(load_row(e, &from[k], &doubles), e->count, floats.floats);
        store_row(e, &to[k], &floats);
    }
}

void operation_move(const Evaluation *e, Instruction i) {
    const Program *program = e->program;
    Register *to = &e->registers->own[i.to];
    const void **place = &e->registers->places[i.to];

    switch (i.operation) {
    case LOAD_ROW:
        *place = load_row(e, &program->rows[i.extra], to);
        break;
    case LOAD_FAILED:
    case LOAD_STOPPED:
        *place = to;
        load_flag(e, i.operation, to->flags);
        break;
    case STORE_ROW:
        store_row(e, &program->rows[i.extra], e->registers->places[i.a]);
        break;
    default:
        store_floats(e, &program->rows[i.a], &program->rows[i.extra], i.b);
    }
}
