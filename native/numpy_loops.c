#include "operations.h"

#include "platform.h"
#include "quick.h"

enum { FEW = 8 };

WIDE static bool is_any_set(const int64_t *flags, size_t lanes) {
    int64_t any = 0;

    for (size_t j = 0; j < lanes / PROGRAM_BLOCK * PROGRAM_BLOCK; j++) {
        any |= flags[j];
    }
    return any != 0;
}

/* The casts drop const: a loop of numpy does not write to its inputs. */
static void call_all(const Evaluation *e, Instruction i) {
    const Called *called = &e->program->calls[i.extra];
    const void *const *places = e->registers->places;
    Register *to = &e->registers->own[i.to];
    char *data[CALL_VALUES] = {(char *)places[i.a], (char *)places[i.b], (char *)places[i.c]};
    const ptrdiff_t length = (ptrdiff_t)e->count;
    Register other; /* the result that another instruction keeps */

    for (size_t k = called->inputs; k < called->values; k++) {
        data[k] = (char *)(k == called->kept ? to->bytes : other.bytes);
    }
    called->loop(called->context, data, &length, called->sizes, called->auxiliary);
    clear_rest(to, e->count, e->lanes, (size_t)called->sizes[called->kept]);
}

/* Calls the loop for the values that are doubtful. */
static void call_where(const Called *called, size_t count, const int64_t *doubtful,
                       const double *x, const double *y, double *to) {
    double first[PROGRAM_WIDTH], second[PROGRAM_WIDTH], found[PROGRAM_WIDTH];
    uint8_t places[PROGRAM_WIDTH];
    ptrdiff_t number = 0;

    for (size_t j = 0; j < count; j++) {
        places[number] = (uint8_t)j;
        first[number] = x[j];
        second[number] = y[j];
        number += doubtful[j];
    }
    char *data[] = {(char *)first, (char *)second, (char *)found};
    data[called->inputs] = (char *)found;
    if (number > 0) {
        called->loop(called->context, data, &number, called->sizes, called->auxiliary);
    }
    for (ptrdiff_t k = 0; k < number; k++) {
        to[places[k]] = found[k];
    }
}

static void compute_quickly(uint16_t operation, const double *x, const double *y, size_t blocks,
                            double *to, int64_t *doubtful) {
    switch (operation) {
    case CALL_SQUARE:
        quick_square(x, blocks, to, doubtful);
        break;
    case CALL_REMAINDER:
        quick_remainder(x, y, blocks, to, doubtful);
        break;
    case CALL_SINE:
        quick_sine(x, blocks, to, doubtful);
        break;
    default:
        quick_cosine(x, blocks, to, doubtful);
    }
}

static void call_quick(const Evaluation *e, Instruction i) {
    const Called *called = &e->program->calls[i.extra];
    const double *x = e->registers->places[i.a];
    const double *y = called->inputs == 1 ? x : e->registers->places[i.b];
    double *to = e->registers->own[i.to].doubles;
    _Alignas(64) int64_t doubtful[PROGRAM_WIDTH];

    if (called->inputs == 1 && e->count < FEW) { /* for a few, a block takes more time */
        call_all(e, i);
        return;
    }
    compute_quickly(i.operation, x, y, e->lanes / PROGRAM_BLOCK, to, doubtful);
    if (is_any_set(doubtful, e->lanes)) {
        call_where(called, e->count, doubtful, x, y, to);
    }
}

/* Whether two instructions compute the sine and the cosine of the same values, and the second one
 * does not overwrite what the first one reads or writes. */
static bool are_pair(Instruction first, Instruction second) {
    return first.operation == CALL_SINE && second.operation == CALL_COSINE && first.a == second.a &&
           first.to != second.to;
}

static void call_pair(const Evaluation *e, const Instruction *pair) {
    const Called *calls = e->program->calls;
    const double *x = e->registers->places[pair[0].a];
    double *sine = e->registers->own[pair[0].to].doubles;
    double *cosine = e->registers->own[pair[1].to].doubles;
    _Alignas(64) int64_t doubtful[2][PROGRAM_WIDTH];

    e->registers->places[pair[1].to] = cosine;
    quick_sine_and_cosine(x, e->lanes / PROGRAM_BLOCK, sine, cosine, doubtful[0], doubtful[1]);
    call_where(&calls[pair[0].extra], e->count, doubtful[0], x, x, sine);
    call_where(&calls[pair[1].extra], e->count, doubtful[1], x, x, cosine);
}

size_t operation_call(const Evaluation *e, const Instruction *next) {
    const bool is_last = next + 1 == e->program->code + e->program->length;

    if (next->operation == CALL) {
        call_all(e, *next);
    } else if (e->count >= FEW && !is_last && are_pair(next[0], next[1])) {
        call_pair(e, next);
        return 2;
    } else {
        call_quick(e, *next);
    }
    return 1;
}
