/* Programs: the arithmetic of an environment's hooks, evaluated on a run of instances at a time. */

#ifndef FMUGYM_PROGRAM_H
#define FMUGYM_PROGRAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    PROGRAM_WIDTH = 32,   /* instances evaluated together */
    PROGRAM_LENGTH = 128, /* instructions, and so registers, at most */
    PROGRAM_RESULTS = 16  /* results, at most */
};

/* OPERATIONS in fmugym/vector/hooks/program.py has their names in the same order. They are compared
 * when that is imported. */
typedef enum {
    LOAD_OUTPUT,
    LOAD_INPUT,
    LOAD_ACTION,
    LOAD_PARAMETER,
    LOAD_STEP_COUNT,
    LOAD_CONSTANT,
    OP_ADD,
    OP_SUBTRACT,
    OP_MULTIPLY,
    OP_DIVIDE,
    OP_NEGATIVE,
    OP_ABSOLUTE,
    OP_SQUARE_ROOT,
    OP_MINIMUM,
    OP_MAXIMUM,
    OP_LESS,
    OP_LESS_EQUAL,
    OP_GREATER,
    OP_GREATER_EQUAL,
    OP_EQUAL,
    OP_NOT_EQUAL,
    OP_AND,
    OP_OR,
    OP_NOT,
    OP_WHERE,
    NUMBER_OF_OPERATIONS
} Operation;

extern const char *const operation_names[NUMBER_OF_OPERATIONS];

/* Instruction i writes register i. Booleans are 0 and 1. */
typedef struct {
    uint16_t operation;
    uint16_t operands[3];
} Instruction;

typedef struct {
    size_t length;
    size_t number_of_constants;
    size_t number_of_results;
    Instruction code[PROGRAM_LENGTH];
    double constants[PROGRAM_LENGTH];
    uint16_t results[PROGRAM_RESULTS];
} Program;

/* What programs load: rows with one value for each instance. */
typedef struct {
    const double *outputs, *inputs, *parameters;
    const int64_t *actions, *step_counts;
    size_t count; /* length of a row */
    size_t number_of_outputs, number_of_inputs, number_of_parameters;
} Source;

typedef double Registers[PROGRAM_LENGTH][PROGRAM_WIDTH];

/* Once before the first run with these registers: constants stay in their place, and where there
 * are fewer instances than a register is wide, the rest is 0. */
void program_prepare(const Program *program, Registers registers);

/* Whether every operand refers to something that there is. */
bool program_is_sound(const Program *program, const Source *source);

/* Evaluates for the instances from begin on, at most PROGRAM_WIDTH of them. Registers are computed
 * in their full width, as loops of a known length become vector instructions. */
void program_run(const Program *program, const Source *source, size_t begin, size_t count,
                 Registers registers);

#endif
