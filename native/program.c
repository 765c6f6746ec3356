#include "program.h"

#include <float.h>
#include <math.h>
#include <string.h>

#include "fmi.h"
#include "halves.h"
#include "platform.h"
#include "quick.h"

#define NAME_IT(operation, name) [operation] = name,
const char *const operation_names[NUMBER_OF_OPERATIONS] = {EACH_OPERATION(NAME_IT)};
#undef NAME_IT

typedef bool Flag;

/* Soundness */

static size_t number_of_operands(const Program *program, Instruction i) {
    switch (i.operation) {
    case LOAD_ROW:
    case LOAD_ACTION:
    case LOAD_PREVIOUS_ACTION:
    case LOAD_ACTIVE:
    case LOAD_STOPPED:
        return 0;
    case CALL:
        return program->calls[i.extra].inputs;
    case CALL_SQUARE:
    case CALL_REMAINDER:
        return 2;
    case STORE_ROW:
    case STORE_SEEN:
    case CALL_SINE:
    case CALL_COSINE:
    case CAST:
    case TAKE:
    case INTERPOLATE:
    case SQUARE_D:
    case NEGATIVE_D:
    case ABSOLUTE_D:
    case SQRT_D:
    case SQUARE_F:
    case NEGATIVE_F:
    case ABSOLUTE_F:
    case SQRT_F:
    case NEGATIVE_Q:
    case NOT:
        return 1;
    case WHERE_8:
    case WHERE_4:
    case WHERE_2:
    case WHERE_1:
        return 3;
    default:
        return 2;
    }
}

/* Whether an instruction calls a loop with one result that has so many inputs. */
static bool calls_with(const Program *program, Instruction i, size_t inputs) {
    return i.extra < program->number_of_calls && program->calls[i.extra].inputs == inputs &&
           program->calls[i.extra].values == inputs + 1;
}

static bool extra_is_sound(const Program *program, size_t action_elements, Instruction i) {
    switch (i.operation) {
    case LOAD_ROW:
    case STORE_ROW:
        return i.extra < program->number_of_rows;
    case LOAD_ACTION:
    case LOAD_PREVIOUS_ACTION:
        return i.extra < action_elements;
    case STORE_SEEN:
        return i.extra < program->number_of_slots;
    case CALL:
        return i.extra < program->number_of_calls;
    case CALL_SQUARE:
    case CALL_REMAINDER:
        return calls_with(program, i, 2);
    case CALL_SINE:
    case CALL_COSINE:
        return calls_with(program, i, 1);
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

static bool instruction_is_sound(const Program *program, size_t action_elements, Instruction i) {
    if (i.operation >= NUMBER_OF_OPERATIONS || !extra_is_sound(program, action_elements, i) ||
        i.to >= program->registers) {
        return false;
    }
    const uint16_t operands[] = {i.a, i.b, i.c};
    const bool stores = i.operation == STORE_ROW || i.operation == STORE_SEEN;
    if (!stores && i.to < program->number_of_constants) {
        return false;
    }
    for (size_t k = 0; k < 3; k++) {
        /* The loops promise the compiler, by restrict, that they do not write to operands. */
        const bool overwritten =
            !stores && k < number_of_operands(program, i) && operands[k] == i.to;
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

bool program_is_sound(const Program *program, size_t action_elements) {
    if (program->registers > PROGRAM_REGISTERS || !slots_are_sound(program)) {
        return false;
    }
    for (size_t i = 0; i < program->length; i++) {
        if (!instruction_is_sound(program, action_elements, program->code[i])) {
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

/* Memory */

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

#define EACH_ITEM(size, type)                                                                      \
    case size: {                                                                                   \
        type *restrict into = to;                                                                  \
        const type *restrict out = (const type *)from;                                             \
        for (size_t j = 0; j < count; j++) {                                                       \
            into[j * to_step] = out[j * from_step];                                                \
        }                                                                                          \
        break;                                                                                     \
    }

/* Copies count values of size bytes each. The steps are in values. */
static void copy_values(void *to, size_t to_step, const void *from, size_t from_step, size_t count,
                        size_t size) {
    if (to_step == 1 && from_step == 1) {
        memcpy(to, from, count * size);
        return;
    }
    switch (size) {
        EACH_ITEM(8, uint64_t)
        EACH_ITEM(4, uint32_t)
        EACH_ITEM(2, uint16_t)
        EACH_ITEM(1, uint8_t)
    }
}

/* Sets the values after the last of a run to 0. Whole blocks are computed, and what an earlier run
 * has left there could be slow to compute with, or undefined to cast. */
static void clear_rest(Register *to, size_t count, size_t lanes, size_t size) {
    if (count < lanes) {
        memset(to->bytes + count * size, 0, (lanes - count) * size);
    }
}

/* Returns where whole blocks of the values lie: at their own place if they follow each other there,
 * otherwise in a register, to which it copies them. */
static const void *loaded(const char *from, size_t step, size_t size, size_t count,
                          size_t lanes, Register *to) {
    if (step == 1 && count == lanes) {
        return from;
    }
    copy_values(to, 1, from, step, count, size);
    clear_rest(to, count, lanes, size);
    return to;
}

static const void *load_row(const Row *row, size_t begin, size_t count, size_t lanes,
                            Register *to) {
    const char *from = row->data + begin * row->size;

    if (row->changes) { /* a later STORE_ROW must not change what was loaded */
        memcpy(to, from, count * row->size);
        clear_rest(to, count, lanes, row->size);
        return to;
    }
    return loaded(from, 1, row->size, count, lanes, to);
}

static const void *load_action(const Source *s, const char *actions, size_t element, size_t begin,
                               size_t count, size_t lanes, Register *to) {
    const char *from = actions + (begin * s->action_elements + element) * s->action_size;
    return loaded(from, s->action_elements, s->action_size, count, lanes, to);
}

WIDE static void find_active(const int8_t *statuses, const uint8_t *ended, size_t count,
                             uint8_t *restrict to) {
    for (size_t j = 0; j < count; j++) {
        const bool failed = (statuses[j] > STATUS_WARNING) & (statuses[j] != STATUS_TERMINATED);
        to[j] = !failed & !ended[j];
    }
}

WIDE static void find_stopped(const int8_t *statuses, size_t count, uint8_t *restrict to) {
    for (size_t j = 0; j < count; j++) {
        to[j] = statuses[j] == STATUS_TERMINATED;
    }
}

static void load_active(const Source *s, size_t begin, size_t count, uint8_t *to) {
    static const int8_t ok[PROGRAM_WIDTH];
    static const uint8_t none[PROGRAM_WIDTH];

    find_active(s->statuses == NULL ? ok : s->statuses + begin,
                s->ended == NULL ? none : s->ended + begin, count, to);
}

static void load_stopped(const Source *s, size_t begin, size_t count, uint8_t *to) {
    if (s->statuses == NULL) {
        memset(to, 0, count);
    } else {
        find_stopped(s->statuses + begin, count, to);
    }
}

static const uint8_t size_of_type[VALUE_TYPES] = {8, 4, 8, 4, 2, 1, 8, 4, 2, 1, 1, 2};

/* The first loop looks whether there is any such value; nearly always there is none. */
#define NOTE_NOT_FINITE(Type, name, Whole, absolute, most)                                         \
    WIDE static void name(const Type *values, size_t count, Notes *notes) {                        \
        Whole any = 0; /* as wide as the values, so that the compiler can vectorize */             \
        for (size_t j = 0; j < count; j++) {                                                       \
            any |= !(absolute(values[j]) <= most);                                                 \
        }                                                                                          \
        for (size_t j = 0; any != 0 && j < count; j++) {                                           \
            notes->not_finite[j] |= !(absolute(values[j]) <= most);                                \
        }                                                                                          \
    }

NOTE_NOT_FINITE(double, note_not_finite, int64_t, fabs, DBL_MAX)
NOTE_NOT_FINITE(float, note_not_finite32, int32_t, fabsf, FLT_MAX)

static void note_not_finite16(const Half *values, size_t count, Notes *notes) {
    for (size_t j = 0; j < count; j++) {
        notes->not_finite[j] |= !half_is_finite(values[j]);
    }
}

void program_clear_seen(const Program *program, char *const *seen, size_t index) {
    for (size_t i = 0; i < program->number_of_slots; i++) {
        const Slot *slot = &program->slots[i];
        const size_t size = size_of_type[slot->type];
        memset(seen[slot->array] + (index * slot->elements + slot->element) * size, 0, size);
    }
}

static void store_seen(const Slot *slot, const Source *s, size_t begin, size_t count,
                       const void *from, Notes *notes) {
    const size_t size = size_of_type[slot->type];
    char *to = s->seen[slot->array] + (begin * slot->elements + slot->element) * size;

    copy_values(to, slot->elements, from, 1, count, size);
    if (slot->type == VALUE_DOUBLE) {
        note_not_finite(from, count, notes);
    } else if (slot->type == VALUE_FLOAT) {
        note_not_finite32(from, count, notes);
    } else if (slot->type == VALUE_HALF) {
        note_not_finite16(from, count, notes);
    }
}

/* Operations of numpy */

enum { FEW = 8 };

WIDE static bool is_any_set(const uint8_t *flags, size_t lanes) {
    uint8_t any = 0;

    for (size_t j = 0; j < lanes / PROGRAM_BLOCK * PROGRAM_BLOCK; j++) {
        any |= flags[j];
    }
    return any != 0;
}

/* The casts drop const: a loop of numpy does not write to its inputs. */
static void call(const Called *called, size_t count, size_t lanes, const Registers *registers,
                 Instruction i) {
    const void *const *places = registers->places;
    char *data[CALL_VALUES] = {(char *)places[i.a], (char *)places[i.b], (char *)places[i.c]};
    const ptrdiff_t length = (ptrdiff_t)count;
    Register other; /* the result that another instruction keeps */

    for (size_t k = called->inputs; k < called->values; k++) {
        data[k] = (char *)(k == called->kept ? registers->own[i.to].bytes : other.bytes);
    }
    called->loop(called->context, data, &length, called->sizes, called->auxiliary);
    clear_rest(&registers->own[i.to], count, lanes, (size_t)called->sizes[called->kept]);
}

/* Calls the loop for the values that are doubtful. */
static void call_where(const Called *called, size_t count, const uint8_t *doubtful,
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
                            double *to, uint8_t *doubtful) {
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

static void call_quick(const Called *called, size_t count, size_t lanes,
                       const Registers *registers, Instruction i) {
    const double *x = registers->places[i.a], *y = registers->places[i.b];
    double *to = registers->own[i.to].doubles;
    _Alignas(64) uint8_t doubtful[PROGRAM_WIDTH];

    if (called->inputs == 1 && count < FEW) { /* for a few, a block takes more time */
        call(called, count, lanes, registers, i);
        return;
    }
    compute_quickly(i.operation, x, called->inputs == 1 ? x : y, lanes / PROGRAM_BLOCK, to,
                    doubtful);
    if (is_any_set(doubtful, lanes)) {
        call_where(called, count, doubtful, x, called->inputs == 1 ? x : y, to);
    }
}

/* Whether two instructions compute the sine and the cosine of the same values, and the second one
 * does not overwrite what the first one reads or writes. */
static bool are_pair(Instruction first, Instruction second) {
    return first.operation == CALL_SINE && second.operation == CALL_COSINE && first.a == second.a &&
           first.to != second.to;
}

static void call_pair(const Program *program, size_t count, size_t lanes,
                      const Registers *registers, const Instruction *pair) {
    const double *x = registers->places[pair[0].a];
    double *sine = registers->own[pair[0].to].doubles, *cosine = registers->own[pair[1].to].doubles;
    _Alignas(64) uint8_t doubtful[2][PROGRAM_WIDTH];

    quick_sine_and_cosine(x, lanes / PROGRAM_BLOCK, sine, cosine, doubtful[0], doubtful[1]);
    call_where(&program->calls[pair[0].extra], count, doubtful[0], x, x, sine);
    call_where(&program->calls[pair[1].extra], count, doubtful[1], x, x, cosine);
}

#define CAST_LOOP(number, From, To)                                                                \
    case number: {                                                                                 \
        const From *restrict values = from;                                                        \
        To *restrict into = to;                                                                    \
        EACH_LANE(into[j] = (To)values[j]);                                                        \
        break;                                                                                     \
    }

#define CASTS_FROM(number, From)                                                                   \
    case number:                                                                                   \
        switch (to_type) {                                                                         \
            CAST_LOOP(0, From, double)                                                             \
            CAST_LOOP(1, From, float)                                                              \
            CAST_LOOP(2, From, int64_t)                                                            \
            CAST_LOOP(3, From, int32_t)                                                            \
            CAST_LOOP(4, From, int16_t)                                                            \
            CAST_LOOP(5, From, int8_t)                                                             \
            CAST_LOOP(6, From, uint64_t)                                                           \
            CAST_LOOP(7, From, uint32_t)                                                           \
            CAST_LOOP(8, From, uint16_t)                                                           \
            CAST_LOOP(9, From, uint8_t)                                                            \
            CAST_LOOP(10, From, Flag)                                                              \
        }                                                                                          \
        break;

WIDE static void cast_numbers(int from_type, int to_type, const void *from, size_t blocks,
                              void *to) {
    switch (from_type) {
        CASTS_FROM(0, double)
        CASTS_FROM(1, float)
        CASTS_FROM(2, int64_t)
        CASTS_FROM(3, int32_t)
        CASTS_FROM(4, int16_t)
        CASTS_FROM(5, int8_t)
        CASTS_FROM(6, uint64_t)
        CASTS_FROM(7, uint32_t)
        CASTS_FROM(8, uint16_t)
        CASTS_FROM(9, uint8_t)
        CASTS_FROM(10, Flag)
    }
}

/* A half becomes a float first, as in numpy. */
static void cast_halves(const Half *from, int to_type, size_t blocks, void *to) {
    Register floats;

    EACH_LANE(floats.floats[j] = half_to_float(from[j]));
    cast_numbers(VALUE_FLOAT, to_type, floats.floats, blocks, to);
}

/* Integers become floats first, as in numpy. */
static void cast_to_halves(int from_type, const void *from, size_t blocks, Half *to) {
    const double *doubles = from;
    Register floats;

    if (from_type == VALUE_DOUBLE) {
        EACH_LANE(to[j] = half_of(doubles[j]));
        return;
    }
    cast_numbers(from_type, VALUE_FLOAT, from, blocks, floats.floats);
    EACH_LANE(to[j] = half_of(floats.floats[j]));
}

static void cast(uint16_t types, const void *from, size_t blocks, void *to) {
    const int from_type = types / VALUE_TYPES, to_type = types % VALUE_TYPES;

    if (from_type == VALUE_HALF) {
        cast_halves(from, to_type, blocks, to);
    } else if (to_type == VALUE_HALF) {
        cast_to_halves(from_type, from, blocks, to);
    } else {
        cast_numbers(from_type, to_type, from, blocks, to);
    }
}

/* Negative indices count from the end. One outside of the table reads its first value. */
static void take(const Table *table, const int64_t *indices, size_t count, char *to,
                 Notes *notes) {
    const int64_t length = (int64_t)table->length;

    for (size_t j = 0; j < count; j++) {
        int64_t index = indices[j] < 0 ? indices[j] + length : indices[j];
        if (index < 0 || index >= length) {
            notes->outside = true;
            index = 0;
        }
        memcpy(to + j * table->size, table->data + (size_t)index * table->size,
               table->size);
    }
}

/* The index of the last coordinate that is not greater than x; 0 if there is none. */
static size_t place_of(double x, const double *coordinates, size_t count) {
    size_t low = 0, high = count;

    while (high - low > 1) {
        const size_t middle = low + (high - low) / 2;
        if (coordinates[middle] <= x) {
            low = middle;
        } else {
            high = middle;
        }
    }
    return low;
}

/* The arithmetic of numpy.interp. */
static double between(double x, const double *xs, const double *ys, size_t place) {
    const double slope = (ys[place + 1] - ys[place]) / (xs[place + 1] - xs[place]);
    double y = slope * (x - xs[place]) + ys[place];

    if (isnan(y)) {
        y = slope * (x - xs[place + 1]) + ys[place + 1];
        if (isnan(y) && ys[place] == ys[place + 1]) {
            y = ys[place];
        }
    }
    return y;
}

static double interpolated(double x, const double *table, size_t count) {
    const double *xs = table, *ys = table + count;

    if (isnan(x)) {
        return x;
    }
    if (x < xs[0]) {
        return ys[count];
    }
    if (x > xs[count - 1]) {
        return ys[count + 1];
    }
    const size_t place = place_of(x, xs, count);
    return place == count - 1 || xs[place] == x ? ys[place] : between(x, xs, ys, place);
}

static void interpolate(const Table *table, const double *from, size_t count, double *to) {
    const double *values = (const double *)(const void *)table->data;

    for (size_t j = 0; j < count; j++) {
        to[j] = interpolated(from[j], values, table->length / 2 - 1);
    }
}

/* Operations of its own */

#define EACH(Type, Result, expression)                                                             \
    {                                                                                              \
        const Type *restrict x = first, *restrict y = second;                                      \
        Result *restrict r = to;                                                                   \
        (void)y;                                                                                   \
        EACH_LANE(r[j] = (expression));                                                            \
    }                                                                                              \
    break

#define CHOOSE(Type)                                                                               \
    {                                                                                              \
        const uint8_t *restrict chosen = first;                                                    \
        const Type *restrict x = second, *restrict y = third;                                      \
        Type *restrict r = to;                                                                     \
        EACH_LANE(r[j] = chosen[j] ? x[j] : y[j]);                                                 \
    }                                                                                              \
    break

/* Integers wrap around, as those of numpy do. */
#define WRAPPED(expression) (int64_t)(expression)

WIDE static void compute(uint16_t operation, const void *first, const void *second,
                         const void *third, size_t blocks, void *to) {
    switch (operation) {
    case ADD_D:
        EACH(double, double, x[j] + y[j]);
    case SUBTRACT_D:
        EACH(double, double, x[j] - y[j]);
    case MULTIPLY_D:
        EACH(double, double, x[j] * y[j]);
    case DIVIDE_D:
        EACH(double, double, x[j] / y[j]);
    case SQUARE_D:
        EACH(double, double, x[j] * x[j]);
    case NEGATIVE_D:
        EACH(double, double, -x[j]);
    case ABSOLUTE_D:
        EACH(double, double, fabs(x[j]));
    case SQRT_D:
        EACH(double, double, sqrt(x[j]));
    case MINIMUM_D:
        EACH(double, double, x[j] < y[j] || isnan(x[j]) ? x[j] : y[j]);
    case MAXIMUM_D:
        EACH(double, double, x[j] > y[j] || isnan(x[j]) ? x[j] : y[j]);
    case LESS_D:
        EACH(double, uint8_t, x[j] < y[j]);
    case LESS_EQUAL_D:
        EACH(double, uint8_t, x[j] <= y[j]);
    case GREATER_D:
        EACH(double, uint8_t, x[j] > y[j]);
    case GREATER_EQUAL_D:
        EACH(double, uint8_t, x[j] >= y[j]);
    case EQUAL_D:
        EACH(double, uint8_t, x[j] == y[j]);
    case NOT_EQUAL_D:
        EACH(double, uint8_t, x[j] != y[j]);
    case ADD_F:
        EACH(float, float, x[j] + y[j]);
    case SUBTRACT_F:
        EACH(float, float, x[j] - y[j]);
    case MULTIPLY_F:
        EACH(float, float, x[j] * y[j]);
    case DIVIDE_F:
        EACH(float, float, x[j] / y[j]);
    case SQUARE_F:
        EACH(float, float, x[j] * x[j]);
    case NEGATIVE_F:
        EACH(float, float, -x[j]);
    case ABSOLUTE_F:
        EACH(float, float, fabsf(x[j]));
    case SQRT_F:
        EACH(float, float, sqrtf(x[j]));
    case MINIMUM_F:
        EACH(float, float, x[j] < y[j] || isnan(x[j]) ? x[j] : y[j]);
    case MAXIMUM_F:
        EACH(float, float, x[j] > y[j] || isnan(x[j]) ? x[j] : y[j]);
    case ADD_Q:
        EACH(uint64_t, int64_t, WRAPPED(x[j] + y[j]));
    case SUBTRACT_Q:
        EACH(uint64_t, int64_t, WRAPPED(x[j] - y[j]));
    case MULTIPLY_Q:
        EACH(uint64_t, int64_t, WRAPPED(x[j] * y[j]));
    case NEGATIVE_Q:
        EACH(uint64_t, int64_t, WRAPPED(0 - x[j]));
    case LESS_Q:
        EACH(int64_t, uint8_t, x[j] < y[j]);
    case LESS_EQUAL_Q:
        EACH(int64_t, uint8_t, x[j] <= y[j]);
    case GREATER_Q:
        EACH(int64_t, uint8_t, x[j] > y[j]);
    case GREATER_EQUAL_Q:
        EACH(int64_t, uint8_t, x[j] >= y[j]);
    case EQUAL_Q:
        EACH(int64_t, uint8_t, x[j] == y[j]);
    case NOT_EQUAL_Q:
        EACH(int64_t, uint8_t, x[j] != y[j]);
    case AND:
        EACH(uint8_t, uint8_t, x[j] & y[j]);
    case OR:
        EACH(uint8_t, uint8_t, x[j] | y[j]);
    case XOR:
        EACH(uint8_t, uint8_t, x[j] ^ y[j]);
    case NOT:
        EACH(uint8_t, uint8_t, x[j] ^ 1);
    case WHERE_8:
        CHOOSE(uint64_t);
    case WHERE_4:
        CHOOSE(uint32_t);
    case WHERE_2:
        CHOOSE(uint16_t);
    default:
        CHOOSE(uint8_t);
    }
}

/* The power of scalars, which is that of the C library in Python and in numpy. */
static void power(uint16_t operation, size_t count, const void *bases, const void *exponents,
                  Register *to) {
    if (operation == POWER_D) {
        const double *base = bases, *exponent = exponents;
        for (size_t j = 0; j < count; j++) {
            to->doubles[j] = pow(base[j], exponent[j]);
        }
        return;
    }
    const float *base = bases, *exponent = exponents;
    for (size_t j = 0; j < count; j++) {
        to->floats[j] = powf(base[j], exponent[j]);
    }
}

static inline size_t whole_blocks(size_t count) {
    return (count + PROGRAM_BLOCK - 1) / PROGRAM_BLOCK * PROGRAM_BLOCK;
}

/* Moves values between registers and memory that is not the program's. Returns false for any other
 * instruction. */
static bool move(const Program *program, const Source *source, size_t begin, size_t count,
                 Registers *registers, Instruction i, Notes *notes) {
    const size_t lanes = whole_blocks(count);
    Register *to = &registers->own[i.to];
    const void **place = &registers->places[i.to], *first = registers->places[i.a];
    const Row *row;

    switch (i.operation) {
    case LOAD_ROW:
        *place = load_row(&program->rows[i.extra], begin, count, lanes, to);
        return true;
    case LOAD_ACTION:
        *place = load_action(source, source->actions, i.extra, begin, count, lanes, to);
        return true;
    case LOAD_PREVIOUS_ACTION:
        *place = load_action(source, source->previous_actions, i.extra, begin, count, lanes, to);
        return true;
    case STORE_ROW:
        row = &program->rows[i.extra];
        memcpy(row->data + begin * row->size, first, count * row->size);
        return true;
    case STORE_SEEN:
        store_seen(&program->slots[i.extra], source, begin, count, first, notes);
        return true;
    default:
        return false;
    }
}

void program_run(const Program *program, const Source *source, size_t begin, size_t count,
                 Registers *registers, Notes *notes) {
    const size_t lanes = whole_blocks(count);
    const void **places = registers->places;

    const Instruction *end = program->code + program->length;

    for (const Instruction *next = program->code; next < end; next++) {
        const Instruction i = *next;
        if (move(program, source, begin, count, registers, i, notes)) {
            continue;
        }
        Register *to = &registers->own[i.to];
        places[i.to] = to;
        switch (i.operation) {
        case LOAD_ACTIVE:
            load_active(source, begin, count, to->flags);
            clear_rest(to, count, lanes, 1);
            break;
        case LOAD_STOPPED:
            load_stopped(source, begin, count, to->flags);
            clear_rest(to, count, lanes, 1);
            break;
        case CALL:
            call(&program->calls[i.extra], count, lanes, registers, i);
            break;
        case CALL_SINE:
            if (count >= FEW && next + 1 < end && are_pair(i, next[1])) {
                places[next[1].to] = &registers->own[next[1].to];
                call_pair(program, count, lanes, registers, next);
                next++;
                break;
            }
            call_quick(&program->calls[i.extra], count, lanes, registers, i);
            break;
        case CALL_SQUARE:
        case CALL_REMAINDER:
        case CALL_COSINE:
            call_quick(&program->calls[i.extra], count, lanes, registers, i);
            break;
        case CAST:
            cast(i.extra, places[i.a], lanes / PROGRAM_BLOCK, to);
            break;
        case TAKE:
            take(&program->tables[i.extra], places[i.a], count, (char *)to->bytes, notes);
            clear_rest(to, count, lanes, program->tables[i.extra].size);
            break;
        case INTERPOLATE:
            interpolate(&program->tables[i.extra], places[i.a], count, to->doubles);
            clear_rest(to, count, lanes, sizeof(double));
            break;
        case POWER_D:
        case POWER_F:
            power(i.operation, count, places[i.a], places[i.b], to);
            clear_rest(to, count, lanes, i.operation == POWER_D ? sizeof(double) : sizeof(float));
            break;
        default:
            compute(i.operation, places[i.a], places[i.b], places[i.c], lanes / PROGRAM_BLOCK, to);
        }
    }
}
