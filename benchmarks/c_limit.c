/* The limit: a bare C loop over the functions of an FMI 2.0 cart-pole, and nothing else.
 *
 * Each thread steps its own instances and never waits for another. For each instance, it sets an
 * input, does a step, gets four outputs and writes them as float32. If the pole has fallen, it resets
 * the instance and initializes it with new start values. c_limit.py compiles the program and passes
 *
 *     library token instances threads seconds step input output*4 start*4 r:parameter=value...
 *
 * where inputs, outputs and parameters are value references. It prints steps per second, by the wall
 * clock and by processor time. */

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

enum { OUTPUTS = 4, MOST_PARAMETERS = 16 };

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

static uint32_t input, outputs[OUTPUTS], starts[OUTPUTS];
static uint32_t reals[MOST_PARAMETERS], integers[MOST_PARAMETERS];
static double real_values[MOST_PARAMETERS];
static int integer_values[MOST_PARAMETERS];
static size_t number_of_reals, number_of_integers;
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
    double values[OUTPUTS];

    for (size_t i = 0; i < OUTPUTS; i++) {
        values[i] = ((double)(draw(part) >> 11) / 9007199254740992.0 - 0.5) * 0.1;
    }
    check(set_up(component, 0, 0.0, 0.0, 0, 0.0), "setup");
    check(set_real(component, reals, number_of_reals, real_values), "parameters");
    check(set_integer(component, integers, number_of_integers, integer_values), "integers");
    check(set_real(component, starts, OUTPUTS, values), "start values");
    check(enter(component), "enter");
    check(leave(component), "exit");
    part->steps[index] = 0;
}

static void step(Part *part, size_t index) {
    void *component = part->components[index];
    const double force = draw(part) & 1 ? 10.0 : -10.0;
    double values[OUTPUTS];

    check(set_real(component, &input, 1, &force), "input");
    check(do_step(component, (double)part->steps[index]++ * step_size, step_size, 1), "step");
    check(get_real(component, outputs, OUTPUTS, values), "outputs");
    for (size_t i = 0; i < OUTPUTS; i++) {
        part->observations[index * OUTPUTS + i] = (float)values[i];
    }
    if (fabs(values[0]) > 2.4 || fabs(values[2]) > 0.20943951023931953) {
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
    set_integer = (SetInteger *)find(library, "fmi2SetInteger");
}

static void take_parameter(const char *text) {
    const uint32_t reference = (uint32_t)strtoul(text + 2, NULL, 10);
    const double value = atof(strchr(text, '=') + 1);

    if (text[0] == 'r') {
        reals[number_of_reals] = reference;
        real_values[number_of_reals++] = value;
    } else {
        integers[number_of_integers] = reference;
        integer_values[number_of_integers++] = (int)value;
    }
}

static void prepare(Part *part, const char *token, size_t count, size_t seed) {
    part->count = count;
    part->random = 88172645463325252u + 1000003u * seed;
    part->components = calloc(count, sizeof *part->components);
    part->steps = calloc(count, sizeof *part->steps);
    part->observations = calloc(count * OUTPUTS, sizeof *part->observations);
    for (size_t i = 0; i < count; i++) {
        part->components[i] = instantiate("c", 1, token, "file:///", &callbacks, 0, 0);
        initialize(part, i);
    }
}

int main(int argc, char *argv[]) {
    if (argc < 16) {
        fprintf(stderr, "see c_limit.py\n");
        return 1;
    }
    const size_t count = (size_t)atol(argv[3]), threads = (size_t)atol(argv[4]);
    seconds = atof(argv[5]);
    step_size = atof(argv[6]);
    input = (uint32_t)atol(argv[7]);
    for (int i = 0; i < OUTPUTS; i++) {
        outputs[i] = (uint32_t)atol(argv[8 + i]);
        starts[i] = (uint32_t)atol(argv[8 + OUTPUTS + i]);
    }
    for (int i = 8 + 2 * OUTPUTS; i < argc && i < 8 + 2 * OUTPUTS + MOST_PARAMETERS; i++) {
        take_parameter(argv[i]);
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
