#include "program.h"

#include <math.h>
#include <string.h>

#include "platform.h"

const char *const operation_names[NUMBER_OF_OPERATIONS] = {
    [LOAD_OUTPUT] = "output",
    [LOAD_INPUT] = "input",
    [LOAD_ACTION] = "action",
    [LOAD_PARAMETER] = "parameter",
    [LOAD_STEP_COUNT] = "step_count",
    [LOAD_CONSTANT] = "constant",
    [OP_ADD] = "add",
    [OP_SUBTRACT] = "subtract",
    [OP_MULTIPLY] = "multiply",
    [OP_DIVIDE] = "divide",
    [OP_NEGATIVE] = "negative",
    [OP_ABSOLUTE] = "absolute",
    [OP_SQUARE_ROOT] = "square_root",
    [OP_MINIMUM] = "minimum",
    [OP_MAXIMUM] = "maximum",
    [OP_LESS] = "less",
    [OP_LESS_EQUAL] = "less_equal",
    [OP_GREATER] = "greater",
    [OP_GREATER_EQUAL] = "greater_equal",
    [OP_EQUAL] = "equal",
    [OP_NOT_EQUAL] = "not_equal",
    [OP_AND] = "and",
    [OP_OR] = "or",
    [OP_NOT] = "not",
    [OP_WHERE] = "where",
};

/* The number of operands that are registers. */
static size_t number_of_operands(uint16_t operation) {
    if (operation <= LOAD_CONSTANT) {
        return 0;
    }
    if (operation == OP_WHERE) {
        return 3;
    }
    const bool unary = operation == OP_NEGATIVE || operation == OP_ABSOLUTE || operation == OP_SQUARE_ROOT ||
                       operation == OP_NOT;
    return unary ? 1 : 2;
}

static bool load_is_sound(const Program *program, const Source *source, Instruction i) {
    switch (i.operation) {
    case LOAD_OUTPUT:
        return i.operands[0] < source->number_of_outputs;
    case LOAD_INPUT:
        return i.operands[0] < source->number_of_inputs;
    case LOAD_PARAMETER:
        return i.operands[0] < source->number_of_parameters;
    case LOAD_CONSTANT:
        return i.operands[0] < program->number_of_constants;
    case LOAD_ACTION:
    case LOAD_STEP_COUNT:
        return i.operands[0] == 0;
    default:
        return true;
    }
}

/* Unused operands must be 0, so that they refer to an existing register. */
static bool rest_is_zero(Instruction i) {
    const size_t used = i.operation <= LOAD_CONSTANT ? 1 : number_of_operands(i.operation);
    uint16_t rest = 0;

    for (size_t k = used; k < 3; k++) {
        rest |= i.operands[k];
    }
    return rest == 0;
}

static bool instruction_is_sound(const Program *program, const Source *source, size_t place) {
    const Instruction i = program->code[place];

    if (i.operation >= NUMBER_OF_OPERATIONS || !load_is_sound(program, source, i) ||
        !rest_is_zero(i)) {
        return false;
    }
    for (size_t k = 0; k < number_of_operands(i.operation); k++) {
        if (i.operands[k] >= place) {
            return false;
        }
    }
    return true;
}

bool program_is_sound(const Program *program, const Source *source) {
    for (size_t i = 0; i < program->length; i++) {
        if (!instruction_is_sound(program, source, i)) {
            return false;
        }
    }
    for (size_t i = 0; i < program->number_of_results; i++) {
        if (program->results[i] >= program->length) {
            return false;
        }
    }
    return true;
}

static void convert(double *restrict to, const int64_t *restrict from, size_t count) {
    for (size_t j = 0; j < count; j++) {
        to[j] = (double)from[j];
    }
}

static void copy(double *to, const double *from, size_t count) {
    memcpy(to, from, count * sizeof *to);
}

static void load(const Source *s, Instruction i, size_t begin, size_t count, double *to) {
    const size_t offset = i.operands[0] * s->count + begin;

    switch (i.operation) {
    case LOAD_OUTPUT:
        copy(to, s->outputs + offset, count);
        break;
    case LOAD_INPUT:
        copy(to, s->inputs + offset, count);
        break;
    case LOAD_PARAMETER:
        copy(to, s->parameters + offset, count);
        break;
    case LOAD_ACTION:
        convert(to, s->actions + begin, count);
        break;
    case LOAD_STEP_COUNT:
        convert(to, s->step_counts + begin, count);
        break;
    default: /* a constant, which program_prepare has written */
        break;
    }
}

#define EACH(expression)                                                                           \
    for (size_t j = 0; j < PROGRAM_WIDTH; j++) {                                                   \
        to[j] = expression;                                                                        \
    }                                                                                              \
    break

WIDE static void compute(uint16_t operation, const double *restrict a, const double *restrict b,
                    const double *restrict c, double *restrict to) {
    switch (operation) {
    case OP_ADD:
        EACH(a[j] + b[j]);
    case OP_SUBTRACT:
        EACH(a[j] - b[j]);
    case OP_MULTIPLY:
        EACH(a[j] * b[j]);
    case OP_DIVIDE:
        EACH(a[j] / b[j]);
    case OP_NEGATIVE:
        EACH(-a[j]);
    case OP_ABSOLUTE:
        EACH(fabs(a[j]));
    case OP_SQUARE_ROOT:
        EACH(sqrt(a[j]));
    case OP_MINIMUM:
        EACH(a[j] < b[j] || isnan(a[j]) ? a[j] : b[j]);
    case OP_MAXIMUM:
        EACH(a[j] > b[j] || isnan(a[j]) ? a[j] : b[j]);
    case OP_LESS:
        EACH(a[j] < b[j] ? 1.0 : 0.0);
    case OP_LESS_EQUAL:
        EACH(a[j] <= b[j] ? 1.0 : 0.0);
    case OP_GREATER:
        EACH(a[j] > b[j] ? 1.0 : 0.0);
    case OP_GREATER_EQUAL:
        EACH(a[j] >= b[j] ? 1.0 : 0.0);
    case OP_EQUAL:
        EACH(a[j] == b[j] ? 1.0 : 0.0);
    case OP_NOT_EQUAL:
        EACH(a[j] != b[j] ? 1.0 : 0.0);
    case OP_AND:
        EACH(a[j] * b[j]);
    case OP_OR:
        EACH(a[j] > b[j] ? a[j] : b[j]);
    case OP_NOT:
        EACH(1.0 - a[j]);
    default:
        EACH(a[j] != 0.0 ? b[j] : c[j]);
    }
}

static double start_of_register(const Program *program, Instruction i) {
    return i.operation == LOAD_CONSTANT ? program->constants[i.operands[0]] : 0.0;
}

void program_prepare(const Program *program, Registers registers) {
    for (size_t place = 0; place < program->length; place++) {
        const Instruction i = program->code[place];
        const double start = start_of_register(program, i);
        for (size_t j = 0; i.operation <= LOAD_CONSTANT && j < PROGRAM_WIDTH; j++) {
            registers[place][j] = start;
        }
    }
}

void program_run(const Program *program, const Source *source, size_t begin, size_t count,
                 Registers registers) {
    for (size_t place = 0; place < program->length; place++) {
        const Instruction i = program->code[place];

        if (i.operation <= LOAD_CONSTANT) {
            load(source, i, begin, count, registers[place]);
        } else {
            compute(i.operation, registers[i.operands[0]], registers[i.operands[1]],
                    registers[i.operands[2]], registers[place]);
        }
    }
}
