/* x' = A x + B u, y = C x + D u as an FMU of FMI 3.0, with both interfaces.

   The structural parameters m, n and r are the numbers of inputs, states and outputs. New sizes
   make all arrays zero, but for a unit matrix A. An instance refuses what the standard forbids: values
   in another number than the arrays have, sizes outside of the Configuration Mode, reading before
   the initialization. In co-simulation a step is made of small ones by the method of Runge and
   Kutta. */

#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { MOST = 8, SQUARE = MOST * MOST };
enum { OK, WARNING, DISCARD, ERROR };
enum { TIME, M, N, R, A, B, C, D, X_0, U, Y, X, RATES };
enum mode { INSTANTIATED, CONFIGURING, INITIALIZING, RUNNING };

static const double LONGEST_STEP = 1e-3;

typedef struct {
    bool exchange;
    enum mode mode;
    double time;
    size_t m, n, r;
    double a[SQUARE], b[SQUARE], c[SQUARE], d[SQUARE], x_0[MOST], u[MOST], x[MOST];
} Model;

static void resize(Model *me, size_t m, size_t n, size_t r) {
    memset(me->a, 0, (char *)(me->x + MOST) - (char *)me->a);
    me->m = m, me->n = n, me->r = r;
    for (size_t i = 0; i < n; i++) {
        me->a[i * n + i] = 1.0;
    }
}

static int start(Model *me) {
    static const double a[] = {-1.0, 0.5, 0.0, -2.0}, b[] = {1.0, 0.5}, d[] = {0.0, 0.0, 0.25};

    resize(me, 1, 2, 3);
    memcpy(me->a, a, sizeof a);
    memcpy(me->b, b, sizeof b);
    memcpy(me->d, d, sizeof d);
    me->c[0] = me->c[3] = me->c[4] = me->c[5] = 1.0;
    me->x_0[0] = 1.0;
    me->time = 0.0;
    me->mode = INSTANTIATED;
    return OK;
}

static Model *make(bool exchange) {
    Model *me = calloc(1, sizeof *me);
    me->exchange = exchange;
    start(me);
    return me;
}

static void multiply(const double *matrix, size_t rows, size_t columns, const double *vector,
                     double *result) {
    for (size_t i = 0; i < rows; i++) {
        for (size_t j = 0; j < columns; j++) {
            result[i] += matrix[i * columns + j] * vector[j];
        }
    }
}

static void rates_of(const Model *me, const double *x, double *rates) {
    memset(rates, 0, MOST * sizeof *rates);
    multiply(me->a, me->n, me->n, x, rates);
    multiply(me->b, me->n, me->m, me->u, rates);
}

static void move(const Model *me, const double *rates, double step, double *x) {
    for (size_t i = 0; i < me->n; i++) {
        x[i] = me->x[i] + step * rates[i];
    }
}

static void small_step(Model *me, double step) {
    double k1[MOST], k2[MOST], k3[MOST], k4[MOST], x[MOST];

    rates_of(me, me->x, k1);
    move(me, k1, step / 2, x);
    rates_of(me, x, k2);
    move(me, k2, step / 2, x);
    rates_of(me, x, k3);
    move(me, k3, step, x);
    rates_of(me, x, k4);
    for (size_t i = 0; i < me->n; i++) {
        me->x[i] += step / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]);
    }
}

/* The values of a variable, and how many there are; those that are computed come to memory. */
static double *find(Model *me, unsigned reference, size_t *count, double *memory) {
    memset(memory, 0, SQUARE * sizeof *memory);
    switch (reference) {
    case TIME: return *count = 1, &me->time;
    case A: return *count = me->n * me->n, me->a;
    case B: return *count = me->n * me->m, me->b;
    case C: return *count = me->r * me->n, me->c;
    case D: return *count = me->r * me->m, me->d;
    case X_0: return *count = me->n, me->x_0;
    case U: return *count = me->m, me->u;
    case X: return *count = me->n, me->x;
    case RATES: rates_of(me, me->x, memory); return *count = me->n, memory;
    case Y:
        multiply(me->c, me->r, me->n, me->x, memory);
        multiply(me->d, me->r, me->m, me->u, memory);
        return *count = me->r, memory;
    default: return NULL;
    }
}

static bool is_settable(const Model *me, unsigned reference) {
    return reference == U || (reference >= A && reference < X_0) ||
           (reference == X_0 && me->mode != RUNNING);
}

Model *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources,
                                    bool visible, bool logging, void *environment, void *logger) {
    return make(true);
}

Model *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                   bool visible, bool logging, bool event_mode, bool early_return,
                                   const unsigned *intermediate, size_t intermediate_count,
                                   void *environment, void *logger, void *intermediate_update) {
    return make(false);
}

void fmi3FreeInstance(Model *me) {
    free(me);
}

static int enter(Model *me, enum mode from, enum mode to) {
    if (me->mode != from) {
        return ERROR;
    }
    me->mode = to;
    return OK;
}

int fmi3EnterConfigurationMode(Model *me) {
    return enter(me, INSTANTIATED, CONFIGURING);
}

int fmi3ExitConfigurationMode(Model *me) {
    return enter(me, CONFIGURING, INSTANTIATED);
}

int fmi3EnterInitializationMode(Model *me, bool has_tolerance, double tolerance, double begin,
                                bool has_stop, double stop) {
    me->time = begin;
    memcpy(me->x, me->x_0, sizeof me->x);
    return enter(me, INSTANTIATED, INITIALIZING);
}

int fmi3ExitInitializationMode(Model *me) {
    return enter(me, INITIALIZING, RUNNING);
}

int fmi3Terminate(Model *me) {
    return OK;
}

int fmi3Reset(Model *me) {
    return start(me);
}

int fmi3DoStep(Model *me, double time, double step, bool no_set_state, bool *event,
               bool *terminate, bool *early, double *last) {
    const int parts = (int)(step / LONGEST_STEP) + 1;

    for (int i = 0; i < parts; i++) {
        small_step(me, step / parts);
    }
    *event = *terminate = *early = false;
    *last = me->time = time + step;
    return me->exchange || me->mode != RUNNING ? ERROR : OK;
}

int fmi3GetFloat64(Model *me, const unsigned *references, size_t count, double *values,
                   size_t number_of_values) {
    double memory[SQUARE];
    size_t done = 0, size;

    for (size_t i = 0; i < count; i++) {
        const double *own = find(me, references[i], &size, memory);
        if (own == NULL || done + size > number_of_values || me->mode == INSTANTIATED) {
            return ERROR;
        }
        memcpy(values + done, own, size * sizeof *own);
        done += size;
    }
    return done == number_of_values ? OK : ERROR;
}

int fmi3SetFloat64(Model *me, const unsigned *references, size_t count, const double *values,
                   size_t number_of_values) {
    double memory[SQUARE];
    size_t done = 0, size;

    for (size_t i = 0; i < count; i++) {
        double *own = find(me, references[i], &size, memory);
        if (own == NULL || done + size > number_of_values || !is_settable(me, references[i])) {
            return ERROR;
        }
        memcpy(own, values + done, size * sizeof *own);
        done += size;
    }
    return done == number_of_values ? OK : ERROR;
}

int fmi3GetUInt64(Model *me, const unsigned *references, size_t count, unsigned long long *values,
                  size_t number_of_values) {
    for (size_t i = 0; i < count; i++) {
        values[i] = references[i] == M ? me->m : references[i] == N ? me->n : me->r;
    }
    return count == number_of_values ? OK : ERROR;
}

int fmi3SetUInt64(Model *me, const unsigned *references, size_t count,
                  const unsigned long long *values, size_t number_of_values) {
    size_t sizes[] = {me->m, me->n, me->r};

    for (size_t i = 0; i < count; i++) {
        if (references[i] < M || references[i] > R || values[i] > MOST || me->mode != CONFIGURING) {
            return ERROR;
        }
        sizes[references[i] - M] = (size_t)values[i];
    }
    resize(me, sizes[0], sizes[1], sizes[2]);
    return count == number_of_values ? OK : ERROR;
}

/* Model exchange */

int fmi3EnterEventMode(Model *me) {
    return OK;
}

int fmi3EnterContinuousTimeMode(Model *me) {
    return OK;
}

int fmi3UpdateDiscreteStates(Model *me, bool *again, bool *terminate, bool *nominals_changed,
                             bool *states_changed, bool *has_next, double *next) {
    *again = *terminate = *nominals_changed = *states_changed = *has_next = false;
    return OK;
}

int fmi3CompletedIntegratorStep(Model *me, bool no_set_state, bool *event, bool *terminate) {
    *event = *terminate = false;
    return OK;
}

int fmi3SetTime(Model *me, double time) {
    me->time = time;
    return OK;
}

int fmi3GetNumberOfContinuousStates(Model *me, size_t *count) {
    *count = me->n;
    return OK;
}

int fmi3GetNumberOfEventIndicators(Model *me, size_t *count) {
    *count = 0;
    return OK;
}

int fmi3SetContinuousStates(Model *me, const double *x, size_t count) {
    memcpy(me->x, x, count * sizeof *x);
    return count == me->n ? OK : ERROR;
}

int fmi3GetContinuousStates(Model *me, double *x, size_t count) {
    memcpy(x, me->x, count * sizeof *x);
    return count == me->n ? OK : ERROR;
}

int fmi3GetContinuousStateDerivatives(Model *me, double *rates, size_t count) {
    double all[MOST];

    rates_of(me, me->x, all);
    memcpy(rates, all, count * sizeof *rates);
    return count == me->n ? OK : ERROR;
}

int fmi3GetEventIndicators(Model *me, double *indicators, size_t count) {
    return count == 0 ? OK : ERROR;
}

int fmi3GetNominalsOfContinuousStates(Model *me, double *nominals, size_t count) {
    for (size_t i = 0; i < count; i++) {
        nominals[i] = 1.0;
    }
    return count == me->n ? OK : ERROR;
}

/* Derivatives */

static size_t size_of(const Model *me, unsigned reference) {
    return reference == U ? me->m : reference == Y ? me->r : me->n;
}

/* The derivative of an array by another one; NULL if there is none. */
static const double *derivative(const Model *me, unsigned unknown, unsigned known) {
    if ((unknown != Y && unknown != RATES) || (known != X && known != U)) {
        return NULL;
    }
    return unknown == RATES ? (known == X ? me->a : me->b) : (known == X ? me->c : me->d);
}

static size_t sum_of_sizes(const Model *me, const unsigned *references, size_t count) {
    size_t sum = 0;
    for (size_t i = 0; i < count; i++) {
        sum += size_of(me, references[i]);
    }
    return sum;
}

static int differentiate(const Model *me, bool adjoint, const unsigned *unknowns, size_t rows,
                         const unsigned *knowns, size_t columns, const double *seed,
                         size_t seed_size, double *values, size_t value_count) {
    const size_t height = sum_of_sizes(me, unknowns, rows), width = sum_of_sizes(me, knowns, columns);
    size_t top = 0;

    if (seed_size != (adjoint ? height : width) || value_count != (adjoint ? width : height)) {
        return ERROR;
    }
    memset(values, 0, value_count * sizeof *values);
    for (size_t i = 0; i < rows; top += size_of(me, unknowns[i++])) {
        size_t left = 0;
        for (size_t j = 0; j < columns; left += size_of(me, knowns[j++])) {
            const double *matrix = derivative(me, unknowns[i], knowns[j]);
            const size_t n = size_of(me, unknowns[i]), m = size_of(me, knowns[j]);
            for (size_t k = 0; matrix != NULL && k < n * m; k++) {
                const size_t row = top + k / m, column = left + k % m;
                values[adjoint ? column : row] += matrix[k] * seed[adjoint ? row : column];
            }
            if (matrix == NULL) {
                return ERROR;
            }
        }
    }
    return OK;
}

int fmi3GetDirectionalDerivative(Model *me, const unsigned *unknowns, size_t rows,
                                 const unsigned *knowns, size_t columns, const double *seed,
                                 size_t seed_size, double *values, size_t value_count) {
    return differentiate(me, false, unknowns, rows, knowns, columns, seed, seed_size, values,
                         value_count);
}

int fmi3GetAdjointDerivative(Model *me, const unsigned *unknowns, size_t rows,
                             const unsigned *knowns, size_t columns, const double *seed,
                             size_t seed_size, double *values, size_t value_count) {
    return differentiate(me, true, unknowns, rows, knowns, columns, seed, seed_size, values,
                         value_count);
}

/* FMU states */

int fmi3GetFMUState(Model *me, void **state) {
    *state = *state == NULL ? malloc(sizeof *me) : *state;
    memcpy(*state, me, sizeof *me);
    return OK;
}

int fmi3SetFMUState(Model *me, const void *state) {
    memcpy(me, state, sizeof *me);
    return OK;
}

int fmi3FreeFMUState(Model *me, void **state) {
    free(*state);
    *state = NULL;
    return OK;
}

int fmi3SerializedFMUStateSize(Model *me, void *state, size_t *size) {
    *size = sizeof *me;
    return OK;
}

int fmi3SerializeFMUState(Model *me, void *state, char *bytes, size_t size) {
    memcpy(bytes, state, size);
    return OK;
}

int fmi3DeserializeFMUState(Model *me, const char *bytes, size_t size, void **state) {
    *state = malloc(sizeof *me);
    memcpy(*state, bytes, size);
    return OK;
}

const char *fmi3GetVersion(void) {
    return "3.0";
}

#define STUB(name)                                                                                 \
    int name(void) {                                                                               \
        return ERROR;                                                                              \
    }
#include STUBS
