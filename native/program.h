/* Programs: the arithmetic of an environment's hooks, evaluated for a run of instances at a
 * time. */

#ifndef FMUGYM_PROGRAM_H
#define FMUGYM_PROGRAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lanes.h"

enum {
    PROGRAM_REGISTERS = 256, /* maximum number of registers */
    PROGRAM_RESULTS = 3,     /* maximum number of results */
    CALL_VALUES = 4          /* maximum number of inputs and outputs of a loop of numpy */
};

/* OPERATIONS in fmugym/vector/hooks/program.py lists their names in the same order. Importing
 * that module compares the two. The letters are those of numpy's types: d float64, f float32,
 * q int64. Booleans are bytes, 0 or 1. Those that move values come first; arithmetic is from ADD_D
 * to WHERE_1. */
#define EACH_OPERATION(X)                                                                          \
    X(LOAD_ROW, "load_row")                                                                        \
    X(LOAD_ACTION, "load_action")                                                                  \
    X(LOAD_PREVIOUS_ACTION, "load_previous_action")                                                \
    X(LOAD_ACTIVE, "load_active")                                                                  \
    X(LOAD_STOPPED, "load_stopped")                                                                \
    X(STORE_ROW, "store_row")                                                                      \
    X(STORE_SEEN, "store_seen")                                                                    \
    X(STORE_FLOATS, "store_floats")                                                                \
    X(CALL, "call")                                                                                \
    X(CALL_SQUARE, "call_square")                                                                  \
    X(CALL_REMAINDER, "call_remainder")                                                            \
    X(CALL_SINE, "call_sine")                                                                      \
    X(CALL_COSINE, "call_cosine")                                                                  \
    X(CAST, "cast")                                                                                \
    X(TAKE, "take")                                                                                \
    X(INTERPOLATE, "interpolate")                                                                  \
    X(ADD_D, "add d")                                                                              \
    X(SUBTRACT_D, "subtract d")                                                                    \
    X(MULTIPLY_D, "multiply d")                                                                    \
    X(DIVIDE_D, "divide d")                                                                        \
    X(SQUARE_D, "square d")                                                                        \
    X(NEGATIVE_D, "negative d")                                                                    \
    X(ABSOLUTE_D, "absolute d")                                                                    \
    X(SQRT_D, "sqrt d")                                                                            \
    X(MINIMUM_D, "minimum d")                                                                      \
    X(MAXIMUM_D, "maximum d")                                                                      \
    X(LESS_D, "less d")                                                                            \
    X(LESS_EQUAL_D, "less_equal d")                                                                \
    X(GREATER_D, "greater d")                                                                      \
    X(GREATER_EQUAL_D, "greater_equal d")                                                          \
    X(EQUAL_D, "equal d")                                                                          \
    X(NOT_EQUAL_D, "not_equal d")                                                                  \
    X(ADD_F, "add f")                                                                              \
    X(SUBTRACT_F, "subtract f")                                                                    \
    X(MULTIPLY_F, "multiply f")                                                                    \
    X(DIVIDE_F, "divide f")                                                                        \
    X(SQUARE_F, "square f")                                                                        \
    X(NEGATIVE_F, "negative f")                                                                    \
    X(ABSOLUTE_F, "absolute f")                                                                    \
    X(SQRT_F, "sqrt f")                                                                            \
    X(MINIMUM_F, "minimum f")                                                                      \
    X(MAXIMUM_F, "maximum f")                                                                      \
    X(ADD_Q, "add q")                                                                              \
    X(SUBTRACT_Q, "subtract q")                                                                    \
    X(MULTIPLY_Q, "multiply q")                                                                    \
    X(NEGATIVE_Q, "negative q")                                                                    \
    X(LESS_Q, "less q")                                                                            \
    X(LESS_EQUAL_Q, "less_equal q")                                                                \
    X(GREATER_Q, "greater q")                                                                      \
    X(GREATER_EQUAL_Q, "greater_equal q")                                                          \
    X(EQUAL_Q, "equal q")                                                                          \
    X(NOT_EQUAL_Q, "not_equal q")                                                                  \
    X(AND, "and")                                                                                  \
    X(OR, "or")                                                                                    \
    X(XOR, "xor")                                                                                  \
    X(NOT, "not")                                                                                  \
    X(WHERE_8, "where 8")                                                                          \
    X(WHERE_4, "where 4")                                                                          \
    X(WHERE_2, "where 2")                                                                          \
    X(WHERE_1, "where 1")                                                                          \
    X(POWER_D, "scalar_power d")                                                                   \
    X(POWER_F, "scalar_power f")

#define NUMBER_IT(operation, name) operation,
typedef enum { EACH_OPERATION(NUMBER_IT) NUMBER_OF_OPERATIONS } Operation;
#undef NUMBER_IT

extern const char *const operation_names[NUMBER_OF_OPERATIONS];

/* TYPES in fmugym/vector/hooks/program.py lists them in the same order. A cast's extra is
 * from * VALUE_TYPES + to. */
#define EACH_TYPE(X)                                                                               \
    X(double, 'd')                                                                                 \
    X(float, 'f')                                                                                  \
    X(int64_t, 'q')                                                                                \
    X(int32_t, 'i')                                                                                \
    X(int16_t, 'h')                                                                                \
    X(int8_t, 'b')                                                                                 \
    X(uint64_t, 'Q')                                                                               \
    X(uint32_t, 'I')                                                                               \
    X(uint16_t, 'H')                                                                               \
    X(uint8_t, 'B')                                                                                \
    X(Flag, '?')                                                                                   \
    X(Half, 'e')

enum { MOST_SEEN = 64 /* maximum number of arrays that a program stores observations in */ };
enum { VALUE_TYPES = 12, VALUE_DOUBLE = 0, VALUE_FLOAT = 1, VALUE_HALF = 11 };

/* to, a, b and c are registers. extra is the number of a row, of an element of an action, of a
 * slot, a call, a table or a pair of types, as the operation needs it. In STORE_FLOATS, extra is the
 * first slot, a the first row, and b how many there are. */
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

/* A loop of numpy: PyArrayMethod_StridedLoop. */
typedef int Loop(void *context, char *const *data, const ptrdiff_t *dimensions,
                 const ptrdiff_t *strides, void *auxiliary);

typedef struct {
    Loop *loop;
    void *context, *auxiliary;
    uint16_t inputs, values, kept; /* number of inputs; of these and outputs; which one is kept */
    ptrdiff_t sizes[CALL_VALUES];  /* bytes of each input, then of each output */
} Called;

/* One value for each instance. */
typedef struct {
    char *data;
    size_t size;  /* bytes of a value */
    bool changes; /* whether the program stores in it */
    uint32_t output; /* 1 more than the number of the output whose values these are, or 0 */
} Row;

/* An element of an array that has the instances on its first axis. */
typedef struct {
    uint32_t array, element, elements; /* elements: of one instance */
    uint32_t type;
} Slot;

/* Values to look up. For an interpolation: n coordinates, n values, and the values to the left
 * and to the right of them. */
typedef struct {
    const char *data;
    size_t length, size;
    bool rising; /* whether coordinates to interpolate between never fall */
} Table;

/* The owner provides the memory that the pointers refer to. */
typedef struct {
    const Instruction *code;
    const Constant *constants;
    const Register *filled; /* the constants, in all places of their registers */
    const Called *calls;
    const Row *rows;
    const Slot *slots;
    const Table *tables;
    size_t length, number_of_constants, number_of_calls, number_of_rows, number_of_slots,
        number_of_tables, number_of_seen, registers, number_of_results;
    uint16_t results[PROGRAM_RESULTS];
} Program;

/* The outputs of a run, which are also in their rows. */
typedef struct {
    const double *lines; /* those of each environment after each other */
    size_t width;        /* the number of outputs */
    bool fits_floats;    /* whether all are finite as floats */
} Fresh;

/* What changes from call to call. */
typedef struct {
    const char *actions, *previous_actions;
    size_t action_size, action_elements;
    const uint8_t *ended;   /* NULL stands for none */
    const int8_t *statuses; /* NULL stands for all OK */
    char *const *seen;      /* the arrays that the slots refer to */
    const Fresh *fresh;     /* NULL if the outputs are in their rows only */
} Source;

/* What a run notes. */
typedef struct {
    uint8_t not_finite[PROGRAM_WIDTH]; /* which instances have stored such a value */
    bool outside;                      /* whether an index was outside of its table */
} Notes;

/* Where the value of each register is: with the constants, in a row, or in memory of its own. */
typedef struct {
    const void *places[PROGRAM_REGISTERS];
    Register *own;
} Registers;

/* Writes a constant in all places of a register. */
void program_fill(const Constant *constant, Register *filled);

/* To be called once, before the first run with these registers. They use the memory, one Register
 * for each of the program. */
void program_prepare(const Program *program, Register *memory, Registers *registers);

/* Whether every operand refers to something that exists. The program writes and reads count
 * instances of rows that are long enough. */
bool program_is_sound(const Program *program, size_t action_elements);

/* Sets what the program would store in the arrays of one instance to 0. */
void program_clear_seen(const Program *program, char *const *seen, size_t index);

/* Evaluates the program for at most PROGRAM_WIDTH instances, starting at begin. Its own operations
 * compute whole blocks, because compilers turn such loops into vector instructions without a
 * remainder; the loops of numpy compute exactly count values. */
void program_run(const Program *program, const Source *source, size_t begin, size_t count,
                 Registers *registers, Notes *notes);

#endif
