/* Evaluation of a program on the arrays of N environments. */

#include "program/program.h"

#include <string.h>

#include "program/operations.h"

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

static size_t size_of_result(Instruction i) {
    return i.operation == POWER_F ? sizeof(float) : sizeof(double);
}

/* The operations that are neither moves nor arithmetic. */
static void run_other(const Evaluation *e, Instruction i) {
    const void *first = e->registers->places[i.a];
    const Table *table = &e->program->tables[i.extra];
    Register *to = &e->registers->own[i.to];

    switch (i.operation) {
    case CAST:
        operation_cast(i.extra, first, e->lanes / PROGRAM_BLOCK, to);
        break;
    case TAKE:
        operation_take(table, first, e->count, (char *)to->bytes, e->notes);
        clear_rest(to, e->count, e->lanes, table->size);
        break;
    case INTERPOLATE:
        operation_interpolate(table, first, e->count, to->doubles);
        clear_rest(to, e->count, e->lanes, sizeof(double));
        break;
    default:
        operation_call(i.operation, first, e->registers->places[i.b], e->count, to);
        clear_rest(to, e->count, e->lanes, size_of_result(i));
    }
}

/* Whether these values of 8 bytes are all the same in a run. Most that differ do so at once. */
static bool are_same(const void *values, size_t count) {
    const size_t size = sizeof(double);
    return memcmp(values, (const char *)values + size, (count - 1) * size) == 0;
}

/* Whether an operation takes much time, and would compute the same for all of a run. */
static bool is_shared(const Evaluation *e, Instruction i) {
    const void *const *places = e->registers->places;
    const bool has_two = i.operation >= ARCTAN2;

    if ((i.operation < SIN && i.operation != INTERPOLATE) || i.operation == POWER_F) {
        return false;
    }
    return are_same(places[i.a], e->count) && (!has_two || are_same(places[i.b], e->count));
}

/* Computes what is the same for all of a run once: what depends on nothing but the time often is. */
static void run_once(const Evaluation *e, Instruction i) {
    Evaluation once = *e;
    uint64_t *to = (uint64_t *)(void *)e->registers->own[i.to].bytes;

    once.count = 1;
    once.lanes = PROGRAM_BLOCK;
    run_other(&once, i);
    for (size_t j = 1; j < e->lanes; j++) {
        to[j] = to[0];
    }
}

static inline void run_one(const Evaluation *e, Instruction i) {
    const void **places = e->registers->places;
    Register *to = &e->registers->own[i.to];

    if (i.operation < CAST) {
        operation_move(e, i);
        return;
    }
    places[i.to] = to;
    if (i.operation >= ADD_D && i.operation < SIN) {
        operation_compute(i.operation, places[i.a], places[i.b], places[i.c],
                          e->lanes / PROGRAM_BLOCK, to);
    } else if (e->count > 1 && is_shared(e, i)) {
        run_once(e, i);
    } else {
        run_other(e, i);
    }
}

/* Whether an instruction and the next one are a sine and a cosine of the same angles. */
static bool is_pair(const Evaluation *e, size_t i) {
    const Instruction *first = &e->program->code[i], *second = first + 1;

    return first->operation <= COS && first->operation >= SIN && i + 1 < e->program->length &&
           second->operation == SIN + COS - first->operation && first->a == second->a &&
           first->to != second->to && !(e->count > 1 && is_shared(e, *first));
}

static void run_pair(const Evaluation *e, Instruction sine, Instruction cosine) {
    Register *sines = &e->registers->own[sine.to], *cosines = &e->registers->own[cosine.to];

    operation_turn(e->registers->places[sine.a], e->count, sines->doubles, cosines->doubles);
    clear_rest(sines, e->count, e->lanes, sizeof(double));
    clear_rest(cosines, e->count, e->lanes, sizeof(double));
    e->registers->places[sine.to] = sines;
    e->registers->places[cosine.to] = cosines;
}

static inline size_t whole_blocks(size_t count) {
    return (count + PROGRAM_BLOCK - 1) / PROGRAM_BLOCK * PROGRAM_BLOCK;
}

void program_run(const Program *program, const Source *source, size_t begin, size_t count,
                 Registers *registers, Notes *notes) {
    const Evaluation e = {program, source, begin, count, whole_blocks(count), registers, notes};

    for (size_t i = 0; i < program->length; i++) {
        const Instruction *next = &program->code[i];
        if (is_pair(&e, i)) {
            const bool is_sine = next->operation == SIN;
            run_pair(&e, next[!is_sine], next[is_sine]);
            i++;
        } else {
            run_one(&e, *next);
        }
    }
}

bool program_evaluate(const Program *program, size_t count) {
    static const Source source;
    Register memory[PROGRAM_REGISTERS];
    Registers registers;
    Notes notes = {.outside = false};

    program_prepare(program, memory, &registers);
    for (size_t begin = 0; begin < count; begin += PROGRAM_WIDTH) {
        const size_t rest = count - begin;
        program_run(program, &source, begin, rest < PROGRAM_WIDTH ? rest : PROGRAM_WIDTH,
                    &registers, &notes);
    }
    return notes.outside;
}
