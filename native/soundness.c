/* Checks of the memory to which a program refers, before it runs. */

#include "program.h"

static size_t number_of_operands(Instruction i) {
    switch (i.operation) {
    case LOAD_ROW:
    case LOAD_ACTIVE:
    case LOAD_STOPPED:
    case STORE_FLOATS:
        return 0;
    case WHERE_8:
    case WHERE_4:
    case WHERE_1:
        return 3;
    case STORE_ROW:
    case STORE_SEEN:
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

static bool store_is_sound(const Program *program, Instruction i) {
    const size_t slots = i.extra + (size_t)i.b, rows = i.a + (size_t)i.b;

    if (i.b == 0 || slots > program->number_of_slots || rows > program->number_of_rows) {
        return false;
    }
    for (size_t k = 0; k < i.b; k++) {
        const Slot *first = &program->slots[i.extra], *slot = first + k;
        if (slot->array != first->array || slot->element != first->element + k ||
            slot->elements != first->elements || slot->type != VALUE_FLOAT ||
            program->rows[i.a + k].size != sizeof(double)) {
            return false;
        }
    }
    return true;
}

static bool extra_is_sound(const Program *program, Instruction i) {
    switch (i.operation) {
    case LOAD_ROW:
    case STORE_ROW:
        return i.extra < program->number_of_rows;
    case STORE_SEEN:
        return i.extra < program->number_of_slots;
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
    const bool stores = i.operation == STORE_ROW || i.operation == STORE_SEEN ||
                        i.operation == STORE_FLOATS;
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

static bool slots_are_sound(const Program *program) {
    for (size_t i = 0; i < program->number_of_slots; i++) {
        const Slot *slot = &program->slots[i];
        if (slot->array >= program->number_of_seen || slot->element >= slot->elements ||
            slot->type >= VALUE_TYPES) {
            return false;
        }
    }
    return true;
}

bool program_is_sound(const Program *program) {
    if (program->registers > PROGRAM_REGISTERS || !slots_are_sound(program)) {
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
    for (size_t i = 0; i < program->number_of_results; i++) {
        if (program->results[i] >= program->registers) {
            return false;
        }
    }
    return true;
}
