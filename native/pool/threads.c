/* Helper threads that take chunks of jobs.
 *
 * The items of a job are divided into one range for each thread that may work on it. Each thread
 * begins with the same range in every job, because the data of that range is in its processor's
 * cache. Then it takes chunks of the other ranges.
 *
 * A job occupies a slot, and slots are never freed. The operating system may suspend a helper
 * after it has found a job and before it takes a chunk. Such a helper does no harm when it wakes
 * up much later. To take a chunk, it must replace the ticket of a range, (epoch, next item), and
 * the epoch has changed by then. So the caller waits for chunks that were taken, never for
 * threads. */

#include "pool/threads.h"

#include <stddef.h>
#include <string.h>

#include "shared/floats.h"
#include "shared/platform.h"

#if !defined _WIN32
#include <signal.h>
#endif

enum {
    SLOTS = 64, /* maximum number of jobs at the same time; a caller beyond it works alone */
    MOST_RANGES = 16,
    MOST_HELPERS = 255,
    WHOLE = 16,           /* number of items whose 32-bit values fill a cache line */
    FANOUT = 2,           /* number of helpers that each thread wakes */
    STACK_SIZE = 8 << 20, /* as for the main thread on most systems: FMUs may rely on it */
    HELPER_SPIN = 50000,  /* ns to look for more work before going to sleep */
    CALLER_SPIN = 5000,   /* ns to wait for the last chunks before going to sleep */
    CALLER_LOOK = 50      /* ms to sleep before it looks what else there is */
};

/* The ticket of a range: epoch << 32 | next item. Mostly, different threads write the tickets. */
typedef struct {
    _Alignas(CACHE_LINE) Atomic value;
} Ticket;

typedef struct {
    Ticket tickets[MOST_RANGES];
    _Alignas(CACHE_LINE) Atomic done;
    _Alignas(CACHE_LINE) Atomic helpers; /* number of helpers at work in this slot */
    Atomic woken;                        /* number of helpers woken for this job */
    /* these stay constant from the opening of the tickets until the job is done */
    _Alignas(CACHE_LINE) Atomic ranges;
    Atomic count;
    Atomic limit; /* maximum number of helpers */
    Atomic smallest;
    Atomic largest;
    Job job;
    Floats floats; /* the caller's floating-point environment */
    /* these are used while the caller waits for the last chunks */
    _Alignas(CACHE_LINE) Atomic waiting; /* whether the caller sleeps */
    Mutex lock;
    Condition finished;
} Slot;

_Static_assert(sizeof(Ticket) == CACHE_LINE, "a ticket has a line of the cache to itself");
_Static_assert(offsetof(Slot, helpers) - offsetof(Slot, done) == CACHE_LINE, "so has done");
_Static_assert(offsetof(Slot, ranges) - offsetof(Slot, helpers) == CACHE_LINE, "so have helpers");

static const uint64_t CLOSED = UINT32_MAX;

static Slot slots[SLOTS];
static _Alignas(CACHE_LINE) Atomic taken;  /* one bit per slot: whether it is in use */
static _Alignas(CACHE_LINE) Atomic opened; /* one bit per slot: whether it has a job */
static _Alignas(CACHE_LINE) Atomic sleeping;
static Atomic started;
static Mutex lock; /* guards going to sleep and starting helpers */
static Condition work_arrived;
static _Alignas(CACHE_LINE) Atomic jobs;
static Atomic wakes, early_wakes, chunks;

static size_t next_item(uint64_t ticket) {
    return (size_t)(ticket & UINT32_MAX);
}

/* If there are many items, ranges begin at whole cache lines, because neighbouring items write
 * next to each other. */
static size_t start_of_range(uint64_t count, uint64_t ranges, uint64_t range) {
    const uint64_t start = count * range / ranges;
    const bool whole = range < ranges && count / ranges >= 4 * WHOLE;
    return (size_t)(whole ? start / WHOLE * WHOLE : start);
}

static size_t end_of_range(const Slot *slot, size_t range) {
    return start_of_range(atomic_get(&slot->count), atomic_get(&slot->ranges), range + 1);
}

/* Chunks are large first and smaller towards the end, so that all threads finish together. The
 * caller begins with a small one. Large chunks are multiples of WHOLE, too. */
static size_t chunk_size(const Slot *slot, size_t left, bool small) {
    const size_t smallest = (size_t)atomic_get(&slot->smallest);
    const size_t largest = (size_t)atomic_get(&slot->largest);
    size_t size = small ? smallest : left / 2;

    size = size > largest ? largest : size;
    size = size < smallest ? smallest : size;
    if (size >= WHOLE) {
        size = (size + WHOLE - 1) / WHOLE * WHOLE;
    }
    return size < left ? size : left;
}

static void finish(Slot *slot, size_t size, size_t count) {
    if (atomic_add(&slot->done, size) + size == count && atomic_get(&slot->waiting)) {
        mutex_lock(&slot->lock);
        condition_wake_all(&slot->finished);
        mutex_unlock(&slot->lock);
    }
}

/* A thread that works on a job. */
typedef struct {
    bool helper;
    uint64_t epoch; /* the job for which it has the caller's floating-point environment */
} Worker;

static void do_chunk(Slot *slot, uint64_t ticket, size_t size, Worker *worker) {
    const size_t count = (size_t)atomic_get(&slot->count), begin = next_item(ticket);

    if (worker->helper && worker->epoch != ticket >> 32) {
        worker->epoch = ticket >> 32;
        floats_restore(&slot->floats); /* results must not depend on the thread */
    }
    slot->job.work(slot->job.context, begin, begin + size);
    finish(slot, size, count);
}

/* Takes a chunk of a range. Returns whether there was one. */
static bool take_chunk(Slot *slot, size_t range, bool small, Worker *worker) {
    Atomic *place = &slot->tickets[range].value;
    uint64_t ticket = atomic_get(place);

    for (;;) {
        const size_t begin = next_item(ticket), end = end_of_range(slot, range);
        if (begin >= end) {
            return false;
        }
        const size_t size = chunk_size(slot, end - begin, small);
        if (atomic_replace(place, &ticket, ticket + size)) {
            do_chunk(slot, ticket, size, worker);
            return true;
        }
    }
}

/* Takes chunks until there are none, first from its own range, then from the others. */
static void take_chunks(Slot *slot, size_t home, Worker worker) {
    const size_t ranges = (size_t)atomic_get(&slot->ranges);
    uint64_t number = 0;

    for (size_t i = 0; i < ranges; i++) {
        while (take_chunk(slot, (home + i) % ranges, false, &worker)) {
            number++;
        }
    }
    atomic_add(&chunks, number);
}

/* Helpers */

static bool has_work(const Slot *slot) {
    if (atomic_get(&slot->helpers) >= atomic_get(&slot->limit)) {
        return false;
    }
    for (size_t i = 0; i < atomic_get(&slot->ranges); i++) {
        if (next_item(atomic_get(&slot->tickets[i].value)) < end_of_range(slot, i)) {
            return true;
        }
    }
    return false;
}

static Slot *find_work(void) {
    uint64_t left = atomic_get(&opened);
    for (size_t i = 0; left != 0; i++, left >>= 1) {
        if ((left & 1) && has_work(&slots[i])) {
            return &slots[i];
        }
    }
    return NULL;
}

static void wake_one(void) {
    mutex_lock(&lock);
    condition_wake_one(&work_arrived);
    mutex_unlock(&lock);
    atomic_add(&wakes, 1);
}

/* Wakes a few of the helpers that a job still needs. Those wake others in turn. */
static void wake_some(Slot *slot) {
    for (int i = 0; i < FANOUT && atomic_get(&sleeping) > 0 && has_work(slot); i++) {
        if (atomic_add(&slot->woken, 1) >= atomic_get(&slot->limit)) {
            return;
        }
        atomic_add(&early_wakes, atomic_get(&slot->done) == 0);
        wake_one();
    }
}

/* Works as a helper. The caller has the first range, so the helpers begin at later ones. */
static void help(Slot *slot, size_t number) {
    if (atomic_add(&slot->helpers, 1) < atomic_get(&slot->limit)) {
        wake_some(slot);
        take_chunks(slot, 1 + number, (Worker){.helper = true, .epoch = UINT64_MAX});
    }
    atomic_add(&slot->helpers, (uint64_t)-1);
}

static Slot *spin_for_work(void) {
    const uint64_t end = clock_now() + HELPER_SPIN;
    Slot *slot = find_work();

    while (slot == NULL && clock_now() < end) {
        spin_pause();
        slot = find_work();
    }
    return slot;
}

static void sleep_until_work(void) {
    mutex_lock(&lock);
    atomic_add(&sleeping, 1);
    while (find_work() == NULL) {
        condition_wait(&work_arrived, &lock);
    }
    atomic_add(&sleeping, (uint64_t)-1);
    mutex_unlock(&lock);
}

static void helper_main(size_t number) {
    for (;;) {
        Slot *slot = spin_for_work();
        if (slot != NULL) {
            help(slot, number);
        } else {
            sleep_until_work();
        }
    }
}

#if defined _WIN32

static DWORD WINAPI helper_entry(void *number) {
    helper_main((size_t)(uintptr_t)number);
    return 0;
}

static bool start_helper(size_t number) {
    HANDLE thread = CreateThread(NULL, STACK_SIZE, helper_entry, (void *)(uintptr_t)number,
                                 STACK_SIZE_PARAM_IS_A_RESERVATION, NULL);
    if (thread != NULL) {
        CloseHandle(thread);
    }
    return thread != NULL;
}

#else

static void *helper_entry(void *number) {
    helper_main((size_t)(uintptr_t)number);
    return NULL;
}

/* Helpers block all signals except faults, so that the threads of the application handle them.
 * Blocked faults would end the process without calling any handler. */
static void block_signals(sigset_t *before) {
    static const int faults[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT, SIGTRAP, SIGSYS};
    sigset_t blocked;

    sigfillset(&blocked);
    for (size_t i = 0; i < sizeof faults / sizeof *faults; i++) {
        sigdelset(&blocked, faults[i]);
    }
    pthread_sigmask(SIG_SETMASK, &blocked, before);
}

static bool start_helper(size_t number) {
    pthread_attr_t attributes;
    pthread_t thread;
    sigset_t before;

    pthread_attr_init(&attributes);
    pthread_attr_setstacksize(&attributes, STACK_SIZE);
    pthread_attr_setdetachstate(&attributes, PTHREAD_CREATE_DETACHED);
    block_signals(&before);
    const bool made =
        pthread_create(&thread, &attributes, helper_entry, (void *)(uintptr_t)number) == 0;
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    pthread_attr_destroy(&attributes);
    return made;
}

#endif

/* If the system refuses to start more, the existing helpers must do. */
static void start_helpers(size_t wanted) {
    wanted = wanted > MOST_HELPERS ? MOST_HELPERS : wanted;
    if (atomic_get(&started) >= wanted) {
        return;
    }
    mutex_lock(&lock);
    while (atomic_get(&started) < wanted && start_helper((size_t)atomic_get(&started))) {
        atomic_add(&started, 1);
    }
    mutex_unlock(&lock);
}

/* The caller */

static Slot *take_slot(void) {
    for (size_t i = 0; i < SLOTS; i++) {
        const uint64_t bit = (uint64_t)1 << i;
        if (!(atomic_or_bits(&taken, bit) & bit)) {
            return &slots[i];
        }
    }
    return NULL;
}

/* The tickets stay closed during the changes, so that no late helper takes a chunk. */
static void open_slot(Slot *slot, const Job *job) {
    const uint64_t epoch = (atomic_get(&slot->tickets[0].value) >> 32) + 1;
    const size_t ranges = job->helpers < MOST_RANGES ? job->helpers + 1 : MOST_RANGES;

    for (size_t i = 0; i < MOST_RANGES; i++) {
        atomic_set(&slot->tickets[i].value, epoch << 32 | CLOSED);
    }
    slot->job = *job;
    slot->floats = floats_now();
    atomic_set(&slot->limit, job->helpers);
    atomic_set(&slot->smallest, job->smallest);
    atomic_set(&slot->largest, job->largest);
    atomic_set(&slot->done, 0);
    atomic_set(&slot->woken, 0);
    atomic_set(&slot->count, job->count);
    atomic_set(&slot->ranges, ranges);
    for (size_t i = 0; i < ranges; i++) {
        const size_t start = start_of_range(job->count, ranges, i);
        atomic_set(&slot->tickets[i].value, epoch << 32 | start);
    }
    atomic_or_bits(&opened, (uint64_t)1 << (slot - slots));
}

static void wait_for_chunks(Slot *slot, size_t count) {
    if (atomic_get(&slot->done) == count) {
        return;
    }
    const uint64_t end = clock_now() + CALLER_SPIN;
    while (clock_now() < end) {
        if (atomic_get(&slot->done) == count) {
            return;
        }
        spin_pause();
    }
    mutex_lock(&slot->lock);
    atomic_set(&slot->waiting, 1);
    while (atomic_get(&slot->done) != count) {
        if (!condition_wait_for(&slot->finished, &slot->lock, CALLER_LOOK)) {
            mutex_unlock(&slot->lock);
            slot->job.look();
            mutex_lock(&slot->lock);
        }
    }
    atomic_set(&slot->waiting, 0);
    mutex_unlock(&slot->lock);
}

/* Helpers that look for work join at once. The caller wakes sleeping ones after its first chunk,
 * when there may be no work left for them; before it, if that lasts. */
void threads_run(const Job *job) {
    Worker caller = {.helper = false};
    Slot *slot = job->helpers == 0 || job->count < 2 ? NULL : take_slot();

    if (slot == NULL) {
        job->work(job->context, 0, job->count);
        return;
    }
    const uint64_t bit = (uint64_t)1 << (slot - slots);
    atomic_add(&jobs, 1);
    start_helpers(job->helpers);
    open_slot(slot, job);
    if (job->lasting) {
        wake_some(slot);
    }
    take_chunk(slot, 0, true, &caller);
    wake_some(slot);
    take_chunks(slot, 0, caller);
    atomic_and_bits(&opened, ~bit);
    wait_for_chunks(slot, job->count);
    atomic_and_bits(&taken, ~bit);
}

ThreadStatistics threads_statistics(void) {
    return (ThreadStatistics){.jobs = atomic_get(&jobs),
                              .wakes = atomic_get(&wakes),
                              .early_wakes = atomic_get(&early_wakes),
                              .chunks = atomic_get(&chunks)};
}

void threads_reset(void) {
    memset((void *)slots, 0, sizeof slots);
    for (size_t i = 0; i < SLOTS; i++) {
        mutex_reset(&slots[i].lock);
        condition_reset(&slots[i].finished);
    }
    atomic_set(&taken, 0);
    atomic_set(&opened, 0);
    atomic_set(&sleeping, 0);
    atomic_set(&started, 0);
    mutex_reset(&lock);
    condition_reset(&work_arrived);
}
