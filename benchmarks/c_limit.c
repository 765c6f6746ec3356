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
 * It prints steps per second, by the wall clock and by processor time. */

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

enum { MOST_ITEMS = 64 };

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

static void initialize(Part *part, size_t index) {
    void *component = part->components[index];
    double values[MOST_ITEMS];
    int whole[MOST_ITEMS];

    for (size_t i = 0; i < starts.count; i++) {
        values[i] = ((double)(draw(part) >> 11) / 9007199254740992.0 - 0.5) * starts.numbers[i];
    }
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
        initialize(part, i);
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
    for (int i = 7; i < argc; i++) {
        take_item(argv[i]);
    }
    load(argv[1]);
    Part *parts = calloc(threads, sizeof *parts);
    pthread_t *ids = calloc(threads, sizeof *ids);
    for (size_t i = 0; i < threads; i++) {
        prepare(&parts[i], argv[2], count / threads + (i < count % threads), i);
    }
    double rate = 0.0, done = 0.0, cpu = 0.0;
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
