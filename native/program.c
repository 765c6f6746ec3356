#include "program.h"

#include <float.h>
#include <math.h>
#include <string.h>

#include "fmi.h"
#include "platform.h"

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
    case STORE_ROW:
    case STORE_SEEN:
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
    for (size_t k = 0; k < number_of_operands(program, i); k++) {
        /* Loops are compiled for operands that are not overwritten. */
        if (operands[k] >= program->registers || (operands[k] == i.to && !stores)) {
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
        if (program->constants[i].to >= program->registers || program->constants[i].size > 8) {
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

void program_prepare(const Program *program, bool has_short_runs, Register *registers) {
    if (has_short_runs) {
        memset(registers, 0, program->registers * sizeof *registers);
    }
    for (size_t i = 0; i < program->number_of_constants; i++) {
        const Constant *constant = &program->constants[i];
        unsigned char *to = registers[constant->to].bytes;
        for (size_t j = 0; j < PROGRAM_WIDTH; j++, to += constant->size) {
            memcpy(to, &constant->bits, constant->size);
        }
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

/* Copies values of some bytes; the steps count values. */
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

static void load_action(const Source *s, const char *actions, size_t element, size_t begin,
                        size_t count, Register *to) {
    const char *from = actions + (begin * s->action_elements + element) * s->action_size;
    copy_values(to, 1, from, s->action_elements, count, s->action_size);
}

static void load_active(const Source *s, size_t begin, size_t count, uint8_t *to) {
    for (size_t j = 0; j < count; j++) {
        const int8_t status = s->statuses == NULL ? 0 : s->statuses[begin + j];
        const bool failed = status > STATUS_WARNING && status != STATUS_TERMINATED;
        to[j] = !failed && !(s->ended != NULL && s->ended[begin + j]);
    }
}

static void load_stopped(const Source *s, size_t begin, size_t count, uint8_t *to) {
    for (size_t j = 0; j < count; j++) {
        to[j] = s->statuses != NULL && s->statuses[begin + j] == STATUS_TERMINATED;
    }
}

static const uint8_t size_of_type[VALUE_TYPES] = {8, 4, 8, 4, 2, 1, 8, 4, 2, 1, 1};

static void note_not_finite(const Register *from, uint32_t type, size_t count, Notes *notes) {
    if (type == VALUE_DOUBLE) {
        for (size_t j = 0; j < count; j++) {
            notes->not_finite[j] |= !(fabs(from->doubles[j]) <= DBL_MAX);
        }
    } else if (type == VALUE_FLOAT) {
        for (size_t j = 0; j < count; j++) {
            notes->not_finite[j] |= !(fabsf(from->floats[j]) <= FLT_MAX);
        }
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
                       const Register *from, Notes *notes) {
    const size_t size = size_of_type[slot->type];
    char *to = s->seen[slot->array] + (begin * slot->elements + slot->element) * size;

    copy_values(to, slot->elements, from, 1, count, size);
    note_not_finite(from, slot->type, count, notes);
}

/* Operations of numpy */

static void call(const Called *called, size_t count, Register *registers, Instruction i) {
    char *data[CALL_INPUTS + 1] = {(char *)&registers[i.a], (char *)&registers[i.b],
                                   (char *)&registers[i.c]};
    const ptrdiff_t length = (ptrdiff_t)count;

    data[called->inputs] = (char *)&registers[i.to];
    called->loop(called->context, data, &length, called->sizes, called->auxiliary);
}

#define CAST_LOOP(number, From, To)                                                                \
    case number: {                                                                                 \
        const From *restrict values = from;                                                        \
        To *restrict into = to;                                                                    \
        for (size_t j = 0; j < PROGRAM_WIDTH; j++) {                                               \
            into[j] = (To)values[j];                                                               \
        }                                                                                          \
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

static void cast(uint16_t types, const void *from, void *to) {
    const int to_type = types % VALUE_TYPES;

    switch (types / VALUE_TYPES) {
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

/* Negative indices count from the end. One outside of the table reads its first value. */
static void take(const Table *table, const int64_t *indices, size_t count, void *to,
                 Notes *notes) {
    const int64_t length = (int64_t)table->length;

    for (size_t j = 0; j < count; j++) {
        int64_t index = indices[j] < 0 ? indices[j] + length : indices[j];
        if (index < 0 || index >= length) {
            notes->outside = true;
            index = 0;
        }
        memcpy((char *)to + j * table->size, table->data + (size_t)index * table->size,
               table->size);
    }
}

/* The last coordinate that is not greater than x, of at least one. */
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
        for (size_t j = 0; j < PROGRAM_WIDTH; j++) {                                               \
            r[j] = expression;                                                                     \
        }                                                                                          \
    }                                                                                              \
    break

#define CHOOSE(Type)                                                                               \
    {                                                                                              \
        const uint8_t *restrict chosen = first;                                                    \
        const Type *restrict x = second, *restrict y = third;                                      \
        Type *restrict r = to;                                                                     \
        for (size_t j = 0; j < PROGRAM_WIDTH; j++) {                                               \
            r[j] = chosen[j] ? x[j] : y[j];                                                        \
        }                                                                                          \
    }                                                                                              \
    break

/* Integers wrap around, as those of numpy do. */
#define WRAPPED(expression) (int64_t)(expression)

WIDE static void compute(uint16_t operation, const void *first, const void *second,
                         const void *third, void *to) {
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
static void power(uint16_t operation, size_t count, const Register *base, const Register *exponent,
                  Register *to) {
    if (operation == POWER_D) {
        for (size_t j = 0; j < count; j++) {
            to->doubles[j] = pow(base->doubles[j], exponent->doubles[j]);
        }
        return;
    }
    for (size_t j = 0; j < count; j++) {
        to->floats[j] = powf(base->floats[j], exponent->floats[j]);
    }
}

void program_run(const Program *program, const Source *source, size_t begin, size_t count,
                 Register *registers, Notes *notes) {
    for (size_t place = 0; place < program->length; place++) {
        const Instruction i = program->code[place];
        Register *to = &registers[i.to];
        const Register *first = &registers[i.a];
        const Row *row;

        switch (i.operation) {
        case LOAD_ROW:
            row = &program->rows[i.extra];
            copy_values(to, 1, row->data + begin * row->size, 1, count, row->size);
            break;
        case LOAD_ACTION:
            load_action(source, source->actions, i.extra, begin, count, to);
            break;
        case LOAD_PREVIOUS_ACTION:
            load_action(source, source->previous_actions, i.extra, begin, count, to);
            break;
        case LOAD_ACTIVE:
            load_active(source, begin, count, to->flags);
            break;
        case LOAD_STOPPED:
            load_stopped(source, begin, count, to->flags);
            break;
        case STORE_ROW:
            row = &program->rows[i.extra];
            copy_values(row->data + begin * row->size, 1, first, 1, count, row->size);
            break;
        case STORE_SEEN:
            store_seen(&program->slots[i.extra], source, begin, count, first, notes);
            break;
        case CALL:
            call(&program->calls[i.extra], count, registers, i);
            break;
        case CAST:
            cast(i.extra, first, to);
            break;
        case TAKE:
            take(&program->tables[i.extra], first->integers, count, to, notes);
            break;
        case INTERPOLATE:
            interpolate(&program->tables[i.extra], first->doubles, count, to->doubles);
            break;
        case POWER_D:
        case POWER_F:
            power(i.operation, count, first, &registers[i.b], to);
            break;
        default:
            compute(i.operation, first, &registers[i.b], &registers[i.c], to);
        }
    }
}
