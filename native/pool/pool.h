/* N instances of one FMU: stepped, reset, saved and restored without Python.
 *
 * The pool writes outputs and statuses into memory of its owner. Any thread may call a pool.
 * Each call begins with pool_enter or pool_try_enter and ends with pool_leave, so that only one
 * thread at a time is inside. A thread that holds the GIL must not wait for a pool, because the
 * thread inside may need the GIL. Such a thread uses pool_try_enter. */

#ifndef FMUGYM_POOL_H
#define FMUGYM_POOL_H

#include "fmi/access.h"
#include "fmi/fmi.h"
#include "fmi/log.h"
#include "model_exchange/methods.h"
#include "shared/floats.h"
#include "shared/platform.h"

/* What a step gives of the values that an output has after each of its substeps.
 * fmugym/pool/pool_spec.py lists their names in this order. */
typedef enum { SAMPLE_LAST, SAMPLE_MEAN, SAMPLE_INTEGRAL, SAMPLE_MIN, SAMPLE_MAX } Sampling;

/* The settings of a pool. Everything they point to must stay in place as long as the pool
 * exists. */
typedef struct {
    const Fmi *fmi;
    const struct System *system; /* NULL for one FMU */
    const char *model; /* the model identifier */
    const char *token;
    const char *resources;
    const char *const *paths; /* path of the library, or of one private copy per instance; of a
                               * system, those of all parts each time */
    bool elsewhere;           /* whether other processes make and step the instances; this one has
                               * no library, and runs the programs around their steps only */
    bool private_libraries;   /* whether each instance has its own library */
    bool logging;             /* whether FMUs are asked to log everything */
    const char *const *categories; /* the log categories of errors and warnings */
    size_t number_of_categories;
    bool can_save;
    bool restores; /* whether an episode with the last start values begins with a restored state */
    bool rebuilds; /* whether each episode begins with a new instance */
    bool reloads;  /* whether a new instance also reloads its private library */
    bool renews;   /* whether resets make parts of a system anew, so that no state outlives one */
    bool returns;  /* whether parts of a system return to earlier states of theirs */
    bool one_initialization; /* whether only one instance in the process may be made, initialized,
                              * reset or freed at a time */
    bool records; /* whether it keeps the inputs of episodes; see recorded_inputs.h */
    int64_t retries; /* of a discarded step, as 2, 4, 8 ... smaller ones; only where it can save */
    Experiment experiment;
    double time_step;
    int64_t substeps;
    int64_t warm_up_steps;
    const Access *inputs, *outputs;
    const unsigned char *sampling; /* one Sampling for each output, or NULL if all are the last */
    size_t num_observed;
    size_t count;
    size_t threads;
    double *output_values; /* one row of count per output */
    int8_t *status;
    int64_t *health; /* one row of HEALTH_COUNTS per instance */
    Solving solving;    /* the method is NULL in co-simulation */
    const char *start_outputs; /* doubles in the place of outputs that the FMU does not tell before
                                * the first step, or NULL */
} Settings;

/* The health counters of each instance. fmugym/pool/health.py lists their names in this order. */
enum {
    RESETS,
    STEPS, /* communication steps until the last reset */
    DISCARDS,
    ERRORS,
    FATALS,
    NOT_FINITE,
    RETRIES,
    REPLACEMENTS,
    RECYCLINGS,
    DEATHS,  /* deaths of processes; not counted here */
    RETRIED, /* retries in the last step */
    HEALTH_COUNTS
};

typedef enum {
    PHASE_DEAD, /* after Fatal, or if there is no instance: no call is legal */
    PHASE_INSTANTIATED,
    PHASE_STEPPING,
    PHASE_ENDED, /* after a step that failed: reading and a reset are legal */
    PHASE_FAILED /* after Error: a reset is legal */
} Phase;

/* Total bytes of the initial states that one pool keeps. */
enum { STATES_LIMIT = 256 << 20 };

/* Why the last status was worse than a warning. */
typedef struct {
    const char *doing; /* what failed; a whole sentence if the status is -1 */
    const char *part;  /* the FMU of a system that failed, or NULL */
    int status;
    bool in_warm_up;
    double time;               /* time of the step, NaN for other calls */
    uint32_t reference;        /* of the String or the known that it was about, or UINT32_MAX */
    char *said;                /* what the FMU logged, or NULL */
    double *values;            /* the inputs or outputs if they caused the failure, or NULL */
    size_t number_of_values;
} Failure;

typedef enum {
    HEARING_LITTLE, /* only what the FMU logs without being asked */
    HEARING_ERRORS, /* also the categories of errors and warnings */
    HEARING_ALL     /* everything, since the FMU failed without a message */
} Hearing;

typedef struct {
    Library *library;
    void *component;
    void *saved;       /* the FMU state after initialization with the start values, or NULL */
    double start_time; /* of its episode */
    int64_t steps;     /* communication steps done */
    int64_t counted;   /* those steps that are already in its health counters */
    Failure *failure;
    uint32_t generation; /* increases whenever the instance is replaced */
    uint8_t phase;
    bool unsavable; /* the FMU once refused to save its state */
    uint8_t hearing;
} Instance;

/* Threads that work on neighbouring instances must not write to the same cache line. */
_Static_assert(sizeof(void *) != 8 || sizeof(Instance) == CACHE_LINE, "an instance fills a line");

/* The state of an instance in the FMU's memory. */
typedef struct {
    void *state; /* NULL if it is gone */
    int64_t steps;
    double start_time;
    uint32_t generation; /* that of the instance */
} Kept;

typedef struct Snapshot {
    struct Snapshot *next; /* next in the list of the pool's snapshots */
    int64_t number;
    Kept kept[]; /* of each instance */
} Snapshot;

/* A value that was set before initialization. */
typedef struct {
    double value; /* 0 for a String */
    uint32_t type, reference, place; /* place: see Element */
    uint32_t size; /* of a String, of its text with the zero at its end */
} RecordedStart;

/* The episodes of all instances so far; see recorded_inputs.h. */
typedef struct Records Records;

typedef struct LibraryCopy LibraryCopy;

enum { SAMPLES = 8 };

/* The measured cost of an operation: a low quantile of the last samples. Other load on the
 * machine makes some samples much too high, but none too low. */
typedef struct {
    double low; /* ns per instance; 0 until it is known */
    double samples[SAMPLES];
    uint32_t taken;
    uint32_t calls;
} Cost;

enum { STEP, RESET, PLAY, RESTORE, BEFORE, AFTER, OPERATIONS };

typedef struct Pool {
    struct Pool *next; /* next in the list of all pools */
    Settings settings;
    double step_size; /* communication step size */
    bool no_return;   /* whether no state will ever be restored */
    bool direct;      /* whether a step is one exchange of doubles */
    Mutex lock;
    Floats floats; /* environment of the thread inside, which FMUs must find */
    Mutex own_making;
    Mutex *making; /* held while an instance is made or freed: FMUs may keep lists of them */
    bool open;
    Log log;
    Library *libraries;
    Instance *instances; /* in instance_memory, aligned to a cache line */
    void *instance_memory;
    double *starts; /* start values of the last initialization, start_width for each instance */
    size_t start_width;
    uint64_t *start_ids; /* the list of start variables of that initialization, or 0 */
    double *first_outputs; /* outputs of the start whose state was saved, if it restores */
    char *names;
    uint32_t *chosen; /* the indices of a call's instances */
    Snapshot *snapshots;
    Records *records; /* NULL if they are not kept */
    Atomic interrupted; /* whether the present call is to end early */
    Atomic found_stiff; /* whether that was told of the equations */
    Cost costs[OPERATIONS];
    Atomic states_too_large;
    Atomic no_categories; /* whether the FMU is asked no more to log why calls fail */
    Atomic heard;         /* how often an instance was asked to log everything */
    LibraryCopy *copies; /* the latest one first; see copies.h */
    unsigned copies_made;
    Atomic copies_used;    /* how many of them have made an instance */
    Atomic copies_in_vain; /* whether the FMU refused an instance of a new copy, too */
} Pool;

/* float64 values, variables first; strides in bytes. */
typedef struct {
    const char *data;
    ptrdiff_t row_stride, column_stride;
} Matrix;

/* One byte for each instance; data is NULL for no mask. */
typedef struct {
    const char *data;
    ptrdiff_t stride;
} Mask;

static inline bool is_in(Mask mask, size_t index) {
    return mask.data != NULL && mask.data[(ptrdiff_t)index * mask.stride] != 0;
}

/* What to do in a call. Fields that the call does not need may be zero. */
typedef struct {
    Matrix inputs; /* inputs of this step, or of the last one */
    Mask mask;
    const Access *start; /* the variables set before initialization */
    Matrix start_values;
    float *observations; /* one row of num_observed for each instance, or NULL */
    const struct Turn *turn; /* what runs before and after the steps, see play.h; or NULL */
    bool alone;          /* whether no other thread may help */
} Call;

/* To be called once per process. */
void pool_prepare_process(void);

/* Loads and instantiates everything. Returns whether that worked; if not, error says why, and
 * the caller must still close the pool. Only pool_open and pool_dispose do not need pool_enter. */
bool pool_open(Pool *pool, const Settings *settings, char *error, size_t size);

/* Frees what a closed pool still holds. Nobody may use the pool afterwards. */
void pool_dispose(Pool *pool);

typedef enum {
    ENTRY_ENTERED, /* the caller must call pool_leave */
    ENTRY_BUSY,    /* another thread is inside */
    ENTRY_CLOSED,
    ENTRY_INSIDE /* this thread is inside: an FMU has called its own pool */
} Entry;

/* Waits for its turn, so it never returns ENTRY_BUSY. */
Entry pool_enter(Pool *pool);
/* Returns at once. */
Entry pool_try_enter(Pool *pool);
void pool_leave(Pool *pool);

/* Callers of all functions below must be inside the pool. */

/* Frees all instances. The pool is then closed to every later caller. */
void pool_close(Pool *pool);

/* Whether a call is known to be so short that others can wait for it. */
bool pool_is_quick(const Pool *pool, int operation);

/* Copies the last failure of an instance. Returns whether there is one. The caller frees said
 * and values. */
bool pool_failure(Pool *pool, size_t index, Failure *copy);

/* Adds all steps so far to the health counters. */
void pool_count_steps(Pool *pool);

/* The following functions return how many instances now have a status worse than a warning. */

/* Steps all instances except those in the mask. Writes all observations. */
size_t pool_step(Pool *pool, const Call *call);
/* Resets the instances in the mask, or all if there is no mask. Writes their observations. */
size_t pool_reset(Pool *pool, const Call *call);
/* How many initializations all pools of this process have begun. */
uint64_t number_of_initializations(void);

/* Returns the index of the first instance that fails, or -1. */
ptrdiff_t pool_read(Pool *pool, const Access *access, double *values);
/* Sets variables between two steps. Returns the index of the first instance that fails, or -1. */
ptrdiff_t pool_write(Pool *pool, const Access *access, const double *values);

#endif
