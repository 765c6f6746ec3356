#include "program.h"

#include <string.h>

#include "operations.h"

#define NAME_IT(operation, name) [operation] = name,
const char *const operation_names[NUMBER_OF_OPERATIONS] = {EACH_OPERATION(NAME_IT)};
#undef NAME_IT

void program_fill(const Constant *constant, Register *filled) {
    unsigned char *to = filled->bytes;

    for (size_t j = 0; j < PROGRAM_WIDTH; j++, to += constant->size) {
        memcpy(to, &constant->bits, constant->size);
    }
}

void program_prepare(const Program *program, Register *memory, Registers *registers) {
    registers->own = memory;
    for (size_t i = 0; i < program->registers; i++) {
        const bool is_constant = i < program->number_of_constants;
        registers->places[i] = is_constant ? program->filled[i].bytes : memory[i].bytes;
    }
}

/* The operations that are neither moves nor arithmetic. */
static size_t run_other(const Evaluation *e, const Instruction *next) {
    const Instruction i = *next;
    const void *first = e->registers->places[i.a];
    Register *to = &e->registers->own[i.to];

    switch (i.operation) {
    case CAST:
        operation_cast(i.extra, first, e->lanes / PROGRAM_BLOCK, to);
        break;
    case TAKE:
        operation_take(&e->program->tables[i.extra], first, e->count, (char *)to->bytes, e->notes);
        clear_rest(to, e->count, e->lanes, e->program->tables[i.extra].size);
        break;
    case INTERPOLATE:
        operation_interpolate(&e->program->tables[i.extra], first, e->count, to->doubles);
        clear_rest(to, e->count, e->lanes, sizeof(double));
        break;
    case POWER_D:
    case POWER_F:
        operation_power(i.operation, e->count, first, e->registers->places[i.b], to);
        clear_rest(to, e->count, e->lanes,
                   i.operation == POWER_D ? sizeof(double) : sizeof(float));
        break;
    default:
        return operation_call(e, next);
    }
    return 1;
}

/* Whether these values of a run are all the same, bit by bit. Most that differ do so at once. */
static bool are_same(const void *values, size_t count, size_t size) {
    return memcmp(values, (const char *)values + size, (count - 1) * size) == 0;
}

/* Whether an operation takes much time, and would compute the same for all of a run. */
static bool is_shared(const Evaluation *e, Instruction i) {
    const void *const *places = e->registers->places;
    const size_t size = sizeof(double); /* these operations take nothing else */

    switch (i.operation) {
    case INTERPOLATE:
    case CALL_SINE:
    case CALL_COSINE:
        return are_same(places[i.a], e->count, size);
    case CALL_REMAINDER:
    case POWER_D:
        return are_same(places[i.a], e->count, size) && are_same(places[i.b], e->count, size);
    default:
        return false;
    }
}

/* Computes what is the same for all of a run once: what depends on nothing but the time often is. */
static size_t run_once(const Evaluation *e, const Instruction *next) {
    Evaluation once = *e;
    double *to = e->registers->own[next->to].doubles;

    once.count = 1;
    once.lanes = PROGRAM_BLOCK;
    const size_t done = run_other(&once, next);
    for (size_t j = 1; j < e->lanes; j++) {
        to[j] = to[0];
    }
    return done;
}

static inline size_t run_one(const Evaluation *e, const Instruction *next) {
    const Instruction i = *next;
    const void **places = e->registers->places;
    Register *to = &e->registers->own[i.to];

    if (i.operation < CALL) {
        operation_move(e, i);
        return 1;
    }
    places[i.to] = to;
    if (i.operation < ADD_D || i.operation >= POWER_D) {
        return e->count > 1 && is_shared(e, i) ? run_once(e, next) : run_other(e, next);
    }
    operation_compute(i.operation, places[i.a], places[i.b], places[i.c], e->lanes / PROGRAM_BLOCK,
                      to);
    return 1;
}

static inline size_t whole_blocks(size_t count) {
    return (count + PROGRAM_BLOCK - 1) / PROGRAM_BLOCK * PROGRAM_BLOCK;
}

void program_run(const Program *program, const Source *source, size_t begin, size_t count,
                 Registers *registers, Notes *notes) {
    const Evaluation e = {program, source, begin, count, whole_blocks(count), registers, notes};
    const Instruction *end = program->code + program->length;

    for (const Instruction *next = program->code; next < end;) {
        next += run_one(&e, next);
    }
}
