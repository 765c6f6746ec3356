/* Checks of the memory to which a program refers, before it runs. */

#include "program/program.h"

static size_t number_of_operands(Instruction i) {
    switch (i.operation) {
    case LOAD_ROW:
    case LOAD_FAILED:
    case LOAD_STOPPED:
    case STORE_FLOATS:
        return 0;
    case WHERE_8:
    case WHERE_4:
    case WHERE_1:
        return 3;
    case STORE_ROW:
    case CAST:
    case TAKE:
    case INTERPOLATE:
    case NEGATIVE_D:
    case NEGATIVE_F:
    case NEGATIVE_Q:
    case ABSOLUTE_D:
    case ABSOLUTE_F:
    case SQRT_D:
    case SQRT_F:
    case FLOOR_D:
    case CEIL_D:
    case TRUNC_D:
    case RINT_D:
    case NOT:
        return 1;
    default:
        return i.operation >= SIN && i.operation <= CBRT ? 1 : 2;
    }
}

static bool can_be_loaded(const Row *row) {
    return row->data != NULL;
}

/* Whether a row is a number of elements after another one in the same array of floats. */
static bool is_float_after(const Row *row, const Row *first, size_t number) {
    const uintptr_t begin = (uintptr_t)first->data + first->offset;

    return (row->data == NULL) == (first->data == NULL) && row->array == first->array &&
           (uintptr_t)row->data + row->offset == begin + number * sizeof(float) &&
           row->stride == first->stride && row->size == sizeof(float);
}

static bool store_is_sound(const Program *program, Instruction i) {
    const size_t number = program->number_of_rows;

    if (i.b == 0 || i.extra + (size_t)i.b > number || i.a + (size_t)i.b > number) {
        return false;
    }
    for (size_t k = 0; k < i.b; k++) {
        const Row *from = &program->rows[i.a + k], *to = &program->rows[i.extra];
        if (!is_float_after(to + k, to, k) || from->size != sizeof(double) ||
            !can_be_loaded(from)) {
            return false;
        }
    }
    return true;
}

static bool extra_is_sound(const Program *program, Instruction i) {
    switch (i.operation) {
    case LOAD_ROW:
        return i.extra < program->number_of_rows && can_be_loaded(&program->rows[i.extra]);
    case STORE_ROW:
        return i.extra < program->number_of_rows;
    case STORE_FLOATS:
        return store_is_sound(program, i);
    case CAST:
        return i.extra < VALUE_TYPES * VALUE_TYPES;
    case TAKE:
        return i.extra < program->number_of_tables && program->tables[i.extra].length > 0;
    case INTERPOLATE:
        return i.extra < program->number_of_tables && program->tables[i.extra].length >= 4 &&
               program->tables[i.extra].length % 2 == 0 && program->tables[i.extra].size == 8;
    default:
        return i.extra == 0;
    }
}

static bool instruction_is_sound(const Program *program, Instruction i) {
    if (i.operation >= NUMBER_OF_OPERATIONS || !extra_is_sound(program, i) ||
        i.to >= program->registers) {
        return false;
    }
    const uint16_t operands[] = {i.a, i.b, i.c};
    const bool stores = i.operation == STORE_ROW || i.operation == STORE_FLOATS;
    if (!stores && i.to < program->number_of_constants) {
        return false;
    }
    if (i.operation == STORE_FLOATS) { /* it has no registers */
        return true;
    }
    for (size_t k = 0; k < 3; k++) {
        /* The loops promise the compiler, by restrict, that they do not write to operands. */
        const bool overwritten =
            !stores && k < number_of_operands(i) && operands[k] == i.to;
        if (operands[k] >= program->registers || overwritten) {
            return false;
        }
    }
    return true;
}

bool program_is_sound(const Program *program) {
    if (program->registers > PROGRAM_REGISTERS) {
        return false;
    }
    for (size_t i = 0; i < program->length; i++) {
        if (!instruction_is_sound(program, program->code[i])) {
            return false;
        }
    }
    for (size_t i = 0; i < program->number_of_constants; i++) {
        if (i >= program->registers || program->constants[i].to != i ||
            program->constants[i].size > 8) {
            return false;
        }
    }
    return true;
}
