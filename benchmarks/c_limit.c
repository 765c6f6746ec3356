/* The limit: a bare C loop over the functions of an FMU of FMI 2.0, and nothing else.
 *
 * Each thread steps its own instances and never waits for another. For each instance, it sets the
 * inputs, does a step, gets the outputs and writes them as float32. If an output is beyond its limit,
 * it resets the instance and initializes it with new start values. c_limit.py compiles the program
 * and passes
 *
 *     library token instances threads seconds step item...
 *
 * where an item is a kind, a value reference and a number:
 *
 *     u:reference=magnitude  an input, which gets this number with a random sign
 *     y:reference=limit      an output, and the largest absolute value before a reset
 *     s:reference=width      a start value, drawn from an interval of this width around 0
 *     r:reference=value      a Real parameter
 *     i:reference=value      an Integer or Enumeration parameter
 *
 * It prints steps per second, by the wall clock and by processor time.
 *
 * With one more item, @path, it repeats the steps that a file tells, by one thread, over and over for
 * these seconds. The file has int64 numbers: instances, steps, start values of an instance; then the
 * start values of all instances; then for each step a byte for each instance, 1 where an episode
 * starts instead of a step, the inputs of all instances, and the start values of those that start.
 * The program then prints the least time in s that each 16 steps of all instances have taken, without
 * the starts of episodes. */

#define _GNU_SOURCE

#include <dlfcn.h>
#include <math.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { MOST_ITEMS = 64, BLOCK = 16 };

typedef struct {
    void (*logger)(void *, const char *, int, const char *, const char *, ...);
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*step_finished)(void *, int);
    void *environment;
} Callbacks;

typedef void *Instantiate(const char *, int, const char *, const char *, const Callbacks *, int,
                          int);
typedef int SetUp(void *, int, double, double, int, double);
typedef int Plain(void *);
typedef int DoStep(void *, double, double, int);
typedef int GetReal(void *, const uint32_t *, size_t, double *);
typedef int SetReal(void *, const uint32_t *, size_t, const double *);
typedef int SetInteger(void *, const uint32_t *, size_t, const int *);

static Instantiate *instantiate;
static SetUp *set_up;
static Plain *enter, *leave, *reset;
static DoStep *do_step;
static GetReal *get_real;
static SetReal *set_real;
static SetInteger *set_integer;

/* Variables of one kind. */
typedef struct {
    size_t count;
    uint32_t references[MOST_ITEMS];
    double numbers[MOST_ITEMS];
} Items;

static Items inputs, outputs, starts, reals, integers;
static double step_size, seconds;

typedef struct {
    void **components;
    int64_t *steps;
    float *observations;
    size_t count;
    uint64_t random;
    double steps_done, rate, cpu; /* steps, steps per second, processor time */
    char padding[128]; /* the next part belongs to another thread: they share no cache line */
} Part;

static void logger(void *environment, const char *name, int status, const char *category,
                   const char *format, ...) {
    (void)environment, (void)name, (void)status, (void)category, (void)format;
}

static const Callbacks callbacks = {logger, calloc, free, NULL, NULL};

static void check(int status, const char *what) {
    if (status > 1) {
        fprintf(stderr, "%s returned %d\n", what, status);
        exit(1);
    }
}

static uint64_t draw(Part *part) {
    part->random ^= part->random << 13;
    part->random ^= part->random >> 7;
    part->random ^= part->random << 17;
    return part->random;
}

static void initialize_with(Part *part, size_t index, const double *values) {
    void *component = part->components[index];
    int whole[MOST_ITEMS];

    for (size_t i = 0; i < integers.count; i++) {
        whole[i] = (int)integers.numbers[i];
    }
    check(set_up(component, 0, 0.0, 0.0, 0, 0.0), "setup");
    check(set_real(component, reals.references, reals.count, reals.numbers), "parameters");
    if (integers.count > 0) {
        check(set_integer(component, integers.references, integers.count, whole), "integers");
    }
    check(set_real(component, starts.references, starts.count, values), "start values");
    check(enter(component), "enter");
    check(leave(component), "exit");
    part->steps[index] = 0;
}

static void initialize(Part *part, size_t index) {
    double values[MOST_ITEMS];

    for (size_t i = 0; i < starts.count; i++) {
        values[i] = ((double)(draw(part) >> 11) / 9007199254740992.0 - 0.5) * starts.numbers[i];
    }
    initialize_with(part, index, values);
}

static void step(Part *part, size_t index) {
    void *component = part->components[index];
    const double sign = draw(part) & 1 ? 1.0 : -1.0;
    double given[MOST_ITEMS], values[MOST_ITEMS];
    int is_beyond = 0;

    for (size_t i = 0; i < inputs.count; i++) {
        given[i] = sign * inputs.numbers[i];
    }
    check(set_real(component, inputs.references, inputs.count, given), "inputs");
    check(do_step(component, (double)part->steps[index]++ * step_size, step_size, 1), "step");
    check(get_real(component, outputs.references, outputs.count, values), "outputs");
    for (size_t i = 0; i < outputs.count; i++) {
        part->observations[index * outputs.count + i] = (float)values[i];
        is_beyond |= fabs(values[i]) > outputs.numbers[i];
    }
    if (is_beyond) {
        check(reset(component), "reset");
        initialize(part, index);
    }
}

static void initialize_all(Part *part) {
    for (size_t i = 0; i < part->count; i++) {
        initialize(part, i);
    }
}

static double now(clockid_t which) {
    struct timespec time;
    clock_gettime(which, &time);
    return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static void *run(void *argument) {
    Part *part = argument;
    const double begin = now(CLOCK_MONOTONIC), cpu = now(CLOCK_THREAD_CPUTIME_ID);
    size_t done = 0;

    do {
        for (size_t i = 0; i < part->count; i++) {
            step(part, i);
        }
        done += part->count;
    } while (done % (part->count * 16) != 0 || now(CLOCK_MONOTONIC) - begin < seconds);
    part->steps_done = (double)done;
    part->rate = (double)done / (now(CLOCK_MONOTONIC) - begin);
    part->cpu = now(CLOCK_THREAD_CPUTIME_ID) - cpu;
    return NULL;
}

/* Steps that are repeated: the header of a file, and what follows it. */
typedef struct {
    int64_t instances, steps, starts;
    const char *first;
} Recorded;

static Recorded read_record(const char *path) {
    FILE *file = fopen(path, "rb");
    Recorded record;
    int64_t header[3];

    if (file == NULL || fread(header, sizeof header, 1, file) != 1) {
        fprintf(stderr, "cannot read %s\n", path);
        exit(1);
    }
    fseek(file, 0, SEEK_END);
    const size_t size = (size_t)ftell(file) - sizeof header;
    char *rest = malloc(size);
    fseek(file, sizeof header, SEEK_SET);
    if (rest == NULL || fread(rest, 1, size, file) != size) {
        fprintf(stderr, "cannot read %s\n", path);
        exit(1);
    }
    fclose(file);
    record = (Recorded){header[0], header[1], header[2], rest};
    return record;
}

/* Starts the episodes that the mask tells, or all if there is none. Returns what follows. */
static const char *start_again(Part *part, const Recorded *record, const char *mask,
                               const char *values) {
    double numbers[MOST_ITEMS];
    const size_t size = (size_t)record->starts * sizeof *numbers;

    for (size_t i = 0; i < part->count; i++) {
        if (mask == NULL || mask[i]) {
            memcpy(numbers, values, size);
            check(reset(part->components[i]), "reset");
            initialize_with(part, i, numbers);
            values += size;
        }
    }
    return values;
}

static void repeat_step(Part *part, const char *mask, const char *given) {
    const size_t size = inputs.count * sizeof(double);
    double values[MOST_ITEMS], numbers[MOST_ITEMS];

    for (size_t i = 0; i < part->count; i++, given += size) {
        if (!mask[i]) {
            memcpy(numbers, given, size);
            const double time = (double)part->steps[i]++ * step_size;
            check(set_real(part->components[i], inputs.references, inputs.count, numbers), "set");
            check(do_step(part->components[i], time, step_size, 1), "step");
            check(get_real(part->components[i], outputs.references, outputs.count, values), "get");
        }
    }
}

static void repeat_once(Part *part, const Recorded *record, double *least) {
    const char *place = start_again(part, record, NULL, record->first);
    const size_t given = inputs.count * sizeof(double) * part->count;
    double taken = 0.0;

    for (int64_t k = 0; k < record->steps; k++) {
        const char *mask = place, *values = place + part->count;
        place = start_again(part, record, mask, values + given);
        const double begin = now(CLOCK_MONOTONIC);
        repeat_step(part, mask, values);
        taken += now(CLOCK_MONOTONIC) - begin;
        if ((k + 1) % BLOCK == 0) {
            least[k / BLOCK] = fmin(least[k / BLOCK], taken);
            taken = 0.0;
        }
    }
}

static void repeat_steps(Part *part, const Recorded *record) {
    const size_t blocks = (size_t)record->steps / BLOCK;
    const double begin = now(CLOCK_MONOTONIC);
    double *least = malloc((blocks + 1) * sizeof *least);

    for (size_t i = 0; i < blocks; i++) {
        least[i] = HUGE_VAL;
    }
    do {
        repeat_once(part, record, least);
    } while (now(CLOCK_MONOTONIC) - begin < seconds);
    for (size_t i = 0; i < blocks; i++) {
        printf("%.9f ", least[i]);
    }
    free(least);
}

static void *find(void *library, const char *name) {
    void *symbol = dlsym(library, name);
    if (symbol == NULL) {
        fprintf(stderr, "no %s\n", name);
        exit(1);
    }
    return symbol;
}

static void load(const char *path) {
    void *library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    if (library == NULL) {
        fprintf(stderr, "%s\n", dlerror());
        exit(1);
    }
    instantiate = (Instantiate *)find(library, "fmi2Instantiate");
    set_up = (SetUp *)find(library, "fmi2SetupExperiment");
    enter = (Plain *)find(library, "fmi2EnterInitializationMode");
    leave = (Plain *)find(library, "fmi2ExitInitializationMode");
    reset = (Plain *)find(library, "fmi2Reset");
    do_step = (DoStep *)find(library, "fmi2DoStep");
    get_real = (GetReal *)find(library, "fmi2GetReal");
    set_real = (SetReal *)find(library, "fmi2SetReal");
    if (integers.count > 0) {
        set_integer = (SetInteger *)find(library, "fmi2SetInteger");
    }
}

static Items *items_of(char kind) {
    switch (kind) {
    case 'u':
        return &inputs;
    case 'y':
        return &outputs;
    case 's':
        return &starts;
    case 'r':
        return &reals;
    default:
        return &integers;
    }
}

static void take_item(const char *text) {
    Items *items = items_of(text[0]);

    if (items->count == MOST_ITEMS) {
        fprintf(stderr, "more than %d variables of one kind\n", MOST_ITEMS);
        exit(1);
    }
    items->references[items->count] = (uint32_t)strtoul(text + 2, NULL, 10);
    items->numbers[items->count++] = atof(strchr(text, '=') + 1);
}

static void prepare(Part *part, const char *token, size_t count, size_t seed) {
    part->count = count;
    part->random = 88172645463325252u + 1000003u * seed;
    part->components = calloc(count, sizeof *part->components);
    part->steps = calloc(count, sizeof *part->steps);
    part->observations = calloc(count * outputs.count + 1, sizeof *part->observations);
    for (size_t i = 0; i < count; i++) {
        part->components[i] = instantiate("c", 1, token, "file:///", &callbacks, 0, 0);
    }
}

int main(int argc, char *argv[]) {
    if (argc < 7) {
        fprintf(stderr, "see c_limit.py\n");
        return 1;
    }
    const size_t count = (size_t)atol(argv[3]), threads = (size_t)atol(argv[4]);
    seconds = atof(argv[5]);
    step_size = atof(argv[6]);
    const int last = argc - (argv[argc - 1][0] == '@');
    for (int i = 7; i < last; i++) {
        take_item(argv[i]);
    }
    load(argv[1]);
    Part *parts = calloc(threads, sizeof *parts);
    pthread_t *ids = calloc(threads, sizeof *ids);
    for (size_t i = 0; i < threads; i++) {
        prepare(&parts[i], argv[2], count / threads + (i < count % threads), i);
    }
    if (last < argc) {
        const Recorded record = read_record(argv[last] + 1);
        repeat_steps(parts, &record);
        return 0;
    }
    double rate = 0.0, done = 0.0, cpu = 0.0;
    for (size_t i = 0; i < threads; i++) {
        initialize_all(&parts[i]);
    }
    for (size_t i = 0; i < threads; i++) {
        pthread_create(&ids[i], NULL, run, &parts[i]);
    }
    for (size_t i = 0; i < threads; i++) {
        pthread_join(ids[i], NULL);
        rate += parts[i].rate;
        done += parts[i].steps_done;
        cpu += parts[i].cpu;
    }
    printf("%.0f %.0f\n", rate, done / cpu);
    return 0;
}
