/* N instances of one FMU: stepped, reset, saved and restored without Python.
 *
 * The pool writes outputs and statuses into memory of its owner. Calls may come from any thread:
 * each begins with pool_enter or pool_try_enter and ends with pool_leave, so that the calls for one
 * pool take turns. Whoever holds the GIL must not wait for a pool, as the thread inside may need
 * it; that is what pool_try_enter is for. */

#ifndef FMUGYM_POOL_H
#define FMUGYM_POOL_H

#include "access.h"
#include "floats.h"
#include "fmi.h"
#include "log.h"
#include "platform.h"
#include "play.h"

typedef struct {
    uint32_t reference;
    const char *text;
} StringValue;

/* What a pool is made from; it must all stay in place as long as the pool does. */
typedef struct {
    const Fmi *fmi;
    const char *model; /* the model identifier */
    const char *token;
    const char *resources;
    const char *const *paths; /* of the library, or of one private copy per instance */
    bool private_libraries;   /* whether there is one for each instance */
    bool logging;
    bool can_save;
    bool restores; /* whether episodes begin by a restored state where the start values are the same
                    */
    bool rebuilds; /* whether each episode begins with a new instance, */
    bool reloads;  /* and with its private library loaded anew */
    int64_t retries; /* of a discarded step, as 2, 4, 8 ... smaller ones; only where it can save */
    Experiment experiment;
    double time_step;
    int64_t substeps;
    int64_t warm_up_steps;
    const StringValue *strings;
    size_t number_of_strings;
    const Access *inputs, *outputs;
    size_t num_observed;
    size_t count;
    size_t threads;
    double *output_values; /* one row of count per output */
    int8_t *status;
    int64_t *health; /* one row of HEALTH_COUNTS per instance */
} Settings;

/* What is counted of each instance; fugym/pool/base.py has the names in this order. */
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
    DEATHS,  /* of processes; not counted here */
    RETRIED, /* in the last step */
    HEALTH_COUNTS
};

typedef enum {
    PHASE_DEAD, /* after Fatal, or where there is no instance: no call is legal */
    PHASE_INSTANTIATED,
    PHASE_STEPPING,
    PHASE_ENDED, /* after a step that was not done: reading and a reset are legal */
    PHASE_FAILED /* after Error: a reset is legal */
} Phase;

/* Why the last status was worse than a warning. */
typedef struct {
    const char *doing; /* what failed; with the status -1 a whole sentence */
    int status;
    bool in_warm_up;
    double time;               /* of a step, NaN for other calls */
    uint32_t string_reference; /* of the String that could not be set, or UINT32_MAX */
    char *said;                /* what the FMU logged, or NULL */
    double *values;            /* the inputs or outputs if these are the reason, or NULL */
    size_t number_of_values;
} Failure;

typedef struct {
    Library *library;
    void *component;
    void *saved;       /* the FMU state after initialization with the start values, or NULL */
    uint64_t start_id; /* of the list of start variables of the last initialization, or 0 */
    int64_t steps;     /* communication steps done */
    int64_t counted;   /* of these, those that are in its health */
    Failure *failure;
    uint32_t generation; /* goes up whenever the instance is replaced */
    uint8_t phase;
    bool unsavable; /* it refused once */
    bool due;       /* to be replaced at its next reset */
} Instance;

/* Threads that work on neighbours do not write to the same line of the cache. */
_Static_assert(sizeof(void *) != 8 || sizeof(Instance) == CACHE_LINE, "an instance fills a line");

typedef struct Snapshot {
    struct Snapshot *next; /* in the list of the pool's snapshots */
    Atomic abandoned;      /* whether the pool is to free it */
    void **states;
    int64_t *steps;
    uint32_t *generations;
} Snapshot;

enum { SAMPLES = 8 };

/* The measured cost of an operation: a low quantile of the last samples. What else the machine does
 * makes some samples many times too high, and none too low. */
typedef struct {
    double low; /* ns per instance; 0 as long as it is unknown */
    double samples[SAMPLES];
    uint32_t taken;
    uint32_t calls;
} Cost;

enum { STEP, RESET, MIXED, PLAY, RESTORE, OPERATIONS };

typedef struct Pool {
    struct Pool *next; /* in the list of all pools */
    Settings settings;
    double step_size; /* of a communication step */
    bool no_return;   /* whether no state will ever be restored */
    bool direct;      /* whether a step is one exchange of doubles */
    Mutex lock;
    Floats floats; /* of the thread inside: the environment that FMUs shall find */
    Mutex making;  /* held while an instance is made or freed: FMUs keep lists of theirs */
    bool open;
    Log log;
    Library *libraries;
    Instance *instances; /* in instance_memory, at the beginning of a line of the cache */
    void *instance_memory;
    double *starts; /* start values of the last initialization, start_width for each instance */
    size_t start_width;
    double *first_outputs; /* after the initialization whose state was saved, where it restores */
    char *names;
    size_t name_size;
    uint32_t *chosen; /* the indices of a call's instances */
    Snapshot *snapshots;
    Atomic abandoned; /* whether any of these has been abandoned */
    Cost costs[OPERATIONS];
    Atomic states_too_large;
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

/* What to do in a call; what is not needed for it may be zero. */
typedef struct {
    Matrix inputs; /* of this step, or those of the last one */
    Mask mask;
    const Access *start; /* the variables set before initialization */
    Matrix start_values;
    float *observations; /* one row of num_observed for each instance, or NULL */
    const Turn *turn;    /* what surrounds the steps, or NULL */
    bool alone;          /* whether no other thread may help */
} Call;

/* To be called once per process. */
void pool_prepare_process(void);

/* Returns whether all could be loaded and instantiated; if not, error tells why, and the pool must
 * be closed. Only pool_open and pool_dispose need no pool_enter. */
bool pool_open(Pool *pool, const Settings *settings, char *error, size_t size);

/* Frees what a closed pool still has. Nobody may use it any more. */
void pool_dispose(Pool *pool);

typedef enum {
    ENTRY_ENTERED, /* pool_leave is due */
    ENTRY_BUSY,    /* another thread is inside */
    ENTRY_CLOSED,
    ENTRY_INSIDE /* this thread is inside: an FMU has called its own pool */
} Entry;

/* Waits for its turn, so never returns ENTRY_BUSY. */
Entry pool_enter(Pool *pool);
/* Returns at once. */
Entry pool_try_enter(Pool *pool);
void pool_leave(Pool *pool);

/* All functions from here on are for those inside. */

/* Frees all instances; the pool is closed for everyone who enters later. */
void pool_close(Pool *pool);

/* Whether a call is known to be so short that nobody will mind waiting for it. */
bool pool_is_quick(const Pool *pool, int operation);

/* Copies the last failure of an instance. Returns whether there is one, of which the caller frees
 * said and values. */
bool pool_failure(Pool *pool, size_t index, Failure *copy);

/* Lets the health have all steps until now. */
void pool_count_steps(Pool *pool);

/* Lets each instance be replaced by a new one at its next reset. */
void pool_recycle(Pool *pool);

/* These return how many of the instances have a status worse than a warning now. */

/* Steps all instances but those in the mask; writes all observations. */
size_t pool_step(Pool *pool, const Call *call);
/* Starts the instances in the mask (all if there is none) anew; writes their observations. */
size_t pool_reset(Pool *pool, const Call *call);
/* Starts those in the mask anew and steps the others; writes all observations. */
size_t pool_step_or_reset(Pool *pool, const Call *call);
/* Starts those anew whose episode has ended and steps the others, with the turn's programs before
 * and after; writes all observations and how many episodes have ended now. */
size_t pool_play(Pool *pool, const Call *call, size_t *ended);

/* Returns the index of the first instance that fails, or -1. */
ptrdiff_t pool_read(Pool *pool, const Access *access, double *values);

/* Snapshots. A new one belongs to the pool that saves its states to it. */

Snapshot *snapshot_new(size_t count); /* NULL without memory */
/* For one that no pool has. */
void snapshot_free(Snapshot *snapshot);
/* Returns the index of the first instance that fails, or -1; then the snapshot has been freed or
 * belongs to the pool. */
ptrdiff_t pool_save(Pool *pool, Snapshot *snapshot);
/* Returns whether all instances in the mask are those that were saved, and how many of them have a
 * status worse than a warning now. */
bool pool_restore(Pool *pool, const Snapshot *snapshot, Mask mask, size_t *troubled);

/* Frees a pool's snapshot, now or once the thread inside the pool leaves. Waits for nobody and may
 * be called from anywhere, so also inside. */
void pool_abandon(Pool *pool, Snapshot *snapshot);

#endif
