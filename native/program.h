/* Programs: the arithmetic of an environment's hooks, evaluated for a run of instances at a
 * time. */

#ifndef FMUGYM_PROGRAM_H
#define FMUGYM_PROGRAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    PROGRAM_WIDTH = 32,   /* instances evaluated at the same time */
    PROGRAM_LENGTH = 128, /* maximum number of instructions and of registers */
    PROGRAM_RESULTS = 16  /* maximum number of results */
};

/* OPERATIONS in fmugym/vector/hooks/program.py lists their names in the same order. Importing
 * that module compares the two. */
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

/* Must be called once before the first run with these registers. Writes the constants, which
 * stay in place. Sets the unused rest to 0 if there are fewer instances than a register is wide. */
void program_prepare(const Program *program, Registers registers);

/* Whether every operand refers to something that exists. */
bool program_is_sound(const Program *program, const Source *source);

/* Evaluates the program for at most PROGRAM_WIDTH instances, starting at begin. Registers are
 * always computed in full width, because loops of a fixed length become vector instructions. */
void program_run(const Program *program, const Source *source, size_t begin, size_t count,
                 Registers registers);

#endif
