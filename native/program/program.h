/* Programs: the arithmetic of an environment's hooks, evaluated for a run of instances at a
 * time. */

#ifndef FMUGYM_PROGRAM_H
#define FMUGYM_PROGRAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "program/lanes.h"

enum { PROGRAM_REGISTERS = 256 /* maximum number of registers */ };

/* OPERATIONS in fmugym/expressions/program.py lists their names in the same order. Who
 * compiles a program compares the two. The letters are those of numpy's types: d float64, f float32,
 * q int64. Booleans are bytes, 0 or 1. Those that move values come first; arithmetic is from ADD_D
 * to WHERE_1; what takes longer is from SIN on, and has one operand until CBRT. */
#define OPERATIONS_OF(X, T, letter)                                                                \
    X(ADD_##T, "add " letter)                                                                      \
    X(SUBTRACT_##T, "subtract " letter)                                                            \
    X(MULTIPLY_##T, "multiply " letter)                                                            \
    X(NEGATIVE_##T, "negative " letter)                                                            \
    X(MINIMUM_##T, "minimum " letter)                                                              \
    X(MAXIMUM_##T, "maximum " letter)                                                              \
    X(LESS_##T, "less " letter)                                                                    \
    X(LESS_EQUAL_##T, "less_equal " letter)                                                        \
    X(GREATER_##T, "greater " letter)                                                              \
    X(GREATER_EQUAL_##T, "greater_equal " letter)                                                  \
    X(EQUAL_##T, "equal " letter)                                                                  \
    X(NOT_EQUAL_##T, "not_equal " letter)

#define EACH_OPERATION(X)                                                                          \
    X(LOAD_ROW, "load_row")                                                                        \
    X(LOAD_FAILED, "load_failed")                                                                  \
    X(LOAD_STOPPED, "load_stopped")                                                                \
    X(STORE_ROW, "store_row")                                                                      \
    X(STORE_FLOATS, "store_floats")                                                                \
    X(CAST, "cast")                                                                                \
    X(TAKE, "take")                                                                                \
    X(INTERPOLATE, "interpolate")                                                                  \
    OPERATIONS_OF(X, D, "d")                                                                       \
    OPERATIONS_OF(X, F, "f")                                                                       \
    OPERATIONS_OF(X, Q, "q")                                                                       \
    X(DIVIDE_D, "divide d")                                                                        \
    X(DIVIDE_F, "divide f")                                                                        \
    X(ABSOLUTE_D, "absolute d")                                                                    \
    X(ABSOLUTE_F, "absolute f")                                                                    \
    X(SQRT_D, "sqrt d")                                                                            \
    X(SQRT_F, "sqrt f")                                                                            \
    X(FLOOR_D, "floor d")                                                                          \
    X(CEIL_D, "ceil d")                                                                            \
    X(TRUNC_D, "trunc d")                                                                          \
    X(RINT_D, "rint d")                                                                            \
    X(BITWISE_AND_Q, "bitwise_and q")                                                              \
    X(BITWISE_XOR_Q, "bitwise_xor q")                                                              \
    X(RIGHT_SHIFT_Q, "right_shift q")                                                              \
    X(AND, "and")                                                                                  \
    X(OR, "or")                                                                                    \
    X(XOR, "xor")                                                                                  \
    X(NOT, "not")                                                                                  \
    X(WHERE_8, "where 8")                                                                          \
    X(WHERE_4, "where 4")                                                                          \
    X(WHERE_1, "where 1")                                                                          \
    X(SIN, "sin d")                                                                                \
    X(COS, "cos d")                                                                                \
    X(TAN, "tan d")                                                                                \
    X(ARCSIN, "arcsin d")                                                                          \
    X(ARCCOS, "arccos d")                                                                          \
    X(ARCTAN, "arctan d")                                                                          \
    X(SINH, "sinh d")                                                                              \
    X(COSH, "cosh d")                                                                              \
    X(TANH, "tanh d")                                                                              \
    X(ARCSINH, "arcsinh d")                                                                        \
    X(ARCCOSH, "arccosh d")                                                                        \
    X(ARCTANH, "arctanh d")                                                                        \
    X(EXP, "exp d")                                                                                \
    X(EXP2, "exp2 d")                                                                              \
    X(EXPM1, "expm1 d")                                                                            \
    X(LOG, "log d")                                                                                \
    X(LOG2, "log2 d")                                                                              \
    X(LOG10, "log10 d")                                                                            \
    X(LOG1P, "log1p d")                                                                            \
    X(CBRT, "cbrt d")                                                                              \
    X(ARCTAN2, "arctan2 d")                                                                        \
    X(HYPOT, "hypot d")                                                                            \
    X(POWER, "power d")                                                                            \
    X(POWER_F, "power f")                                                                          \
    X(FMOD, "fmod d")                                                                              \
    X(COPYSIGN, "copysign d")                                                                      \
    X(REMAINDER, "remainder d")                                                                    \
    X(FLOOR_DIVIDE, "floor_divide d")                                                              \
    X(REMAINDER_Q, "remainder q")                                                                  \
    X(FLOOR_DIVIDE_Q, "floor_divide q")

#define NUMBER_IT(operation, name) operation,
typedef enum { EACH_OPERATION(NUMBER_IT) NUMBER_OF_OPERATIONS } Operation;
#undef NUMBER_IT

extern const char *const operation_names[NUMBER_OF_OPERATIONS];

/* TYPES in fmugym/expressions/program.py lists them in the same order: d, f, q, Booleans, and the
 * bytes of actions that are switches. A cast's extra is from * VALUE_TYPES + to. */
enum { VALUE_DOUBLE, VALUE_FLOAT, VALUE_INTEGER, VALUE_FLAG, VALUE_BYTE, VALUE_TYPES };

enum { MOST_ARRAYS = 67 /* maximum number of arrays that a call brings for programs to store in */ };

/* to, a, b and c are registers. extra is the number of a row, a table or a pair of types, as the
 * operation needs it. In STORE_FLOATS, a is the first row to load, extra the first one to store in, and
 * b how many there are. */
typedef struct {
    uint16_t operation, extra, to, a, b, c;
} Instruction;

typedef union {
    _Alignas(64) unsigned char bytes[8 * PROGRAM_WIDTH];
    double doubles[PROGRAM_WIDTH];
    float floats[PROGRAM_WIDTH];
    int64_t integers[PROGRAM_WIDTH];
    uint8_t flags[PROGRAM_WIDTH];
} Register;

/* A value that the program only reads, the same for all instances. Constants have the first
 * registers. */
typedef struct {
    uint64_t bits; /* the value in its first bytes */
    uint16_t to, size;
    uint32_t unused;
} Constant;

/* One value for each instance, in memory that stays, or in an array that each call brings. Programs
 * only store in the latter. */
typedef struct {
    char *data;    /* NULL if it is in an array of the call */
    size_t array;  /* the number of that array */
    size_t offset; /* bytes from there to the value of the first instance */
    size_t size;   /* bytes of a value */
    size_t stride; /* values from one instance to the next: 1 unless it is an element of an array */
    uint32_t type; /* in an array of the call: VALUE_DOUBLE and so on */
    bool changes; /* whether the program stores in it */
    uint32_t output; /* 1 more than the number of the output whose values these are, or 0 */
} Row;

/* Values to look up. For an interpolation: n coordinates that never fall, n values, and the values to
 * the left and to the right of them. */
typedef struct {
    const char *data;
    size_t length, size;
} Table;

/* The owner provides the memory that the pointers refer to. */
typedef struct {
    const Instruction *code;
    const Constant *constants;
    const Register *filled; /* the constants, in all places of their registers */
    const Row *rows;
    const Table *tables;
    size_t length, number_of_constants, number_of_rows, number_of_tables, registers;
} Program;

/* The outputs of a run, which are also in their rows. */
typedef struct {
    const double *lines; /* those of each environment after each other */
    size_t width;        /* the number of outputs */
    bool fits_floats;    /* whether all are finite as floats */
} Fresh;

/* What changes from call to call. */
typedef struct {
    const int8_t *statuses; /* NULL stands for all OK */
    char *const *arrays;    /* those of the call */
    const Fresh *fresh;     /* NULL if the outputs are in their rows only */
} Source;

/* What a run notes. */
typedef struct {
    uint8_t not_finite[PROGRAM_WIDTH]; /* which instances have stored such a value in an array */
    bool outside;                      /* whether an index was outside of its table */
} Notes;

/* Where the value of each register is: with the constants, in a row, or in memory of its own. */
typedef struct {
    const void *places[PROGRAM_REGISTERS];
    Register *own;
} Registers;

/* The memory of the first instance. */
static inline char *row_begin(const Row *row, char *const *arrays) {
    return row->data == NULL ? arrays[row->array] + row->offset : row->data;
}

/* Writes a constant in all places of a register. */
void program_fill(const Constant *constant, Register *filled);

/* To be called once, before the first run with these registers. They use the memory, one Register
 * for each of the program. */
void program_prepare(const Program *program, Register *memory, Registers *registers);

/* Whether every operand refers to something that exists. The program writes and reads count
 * instances of rows that are long enough. */
bool program_is_sound(const Program *program);

/* Evaluates the program for at most PROGRAM_WIDTH instances, starting at begin. Arithmetic is done
 * for whole blocks, because compilers turn such loops into vector instructions without a remainder;
 * functions of the C library compute exactly count values. */
void program_run(const Program *program, const Source *source, size_t begin, size_t count,
                 Registers *registers, Notes *notes);

/* Evaluates a program outside of a play, for count instances; all of its rows are in memory that stays.
 * Returns whether it looked up an index outside of a table. */
bool program_evaluate(const Program *program, size_t count);

#endif
