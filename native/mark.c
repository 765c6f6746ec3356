#include "mark.h"

#include <errno.h>
#include <stddef.h>

volatile int mark_struck;

#if defined __linux__

#include <pthread.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "inside.h"
#include "platform.h"

enum { PAGE = 4096, HANDLER_STACK = 64 << 10 };

static const int signals[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT};
enum { SIGNALS = sizeof signals / sizeof *signals };

static struct sigaction earlier[SIGNALS];
static Mutex lock = MUTEX_INITIALIZER;

/* The functions of this part run in signal handlers. They neither lock nor allocate. */

static void strike(unsigned char what) {
    const Mark *mark = inside_mark();

    if (mark != NULL && mark->page != NULL && mark->owner == getpid()) {
        mark->page[1] = (unsigned char)inside_call();
        mark->page[0] = what;
        mark_struck = 1;
    }
}

/* Another process may send any signal at any time; that says nothing about the FMU. */
static bool comes_from_here(const siginfo_t *info) {
    return info->si_code > 0 || info->si_pid == getpid();
}

/* A fault occurs again when the handler returns; a signal that was raised has to be repeated. */
static void end_by_default(int number, const siginfo_t *info) {
    signal(number, SIG_DFL);
    if (info->si_code <= 0) {
        raise(number);
    }
}

static void pass_on(int number, siginfo_t *info, void *context) {
    const struct sigaction *action = earlier;

    for (int i = 0; i < SIGNALS && signals[i] != number; i++) {
        action++;
    }
    if (action->sa_flags & SA_SIGINFO) {
        action->sa_sigaction(number, info, context);
    } else if (action->sa_handler != SIG_DFL && action->sa_handler != SIG_IGN) {
        action->sa_handler(number);
    } else if (action->sa_handler == SIG_DFL || info->si_code > 0) {
        end_by_default(number, info);
    }
}

static void on_signal(int number, siginfo_t *info, void *context) {
    const int error = errno;

    if (comes_from_here(info)) {
        strike((unsigned char)number);
    }
    errno = error;
    pass_on(number, info, context);
}

/* The C library calls this in the thread that has called exit. */
static void on_exit_of_process(void) {
    strike(MARK_EXIT);
}

/* Installing */

static bool is_ours(const struct sigaction *action) {
    return (action->sa_flags & SA_SIGINFO) && action->sa_sigaction == on_signal;
}

/* A handler that came after this one usually passes signals on to it, so it stays in front. */
static void install(bool first) {
    for (int i = 0; i < SIGNALS; i++) {
        struct sigaction present, action = {.sa_sigaction = on_signal};

        sigaction(signals[i], NULL, &present);
        const bool is_default = !(present.sa_flags & SA_SIGINFO) && present.sa_handler == SIG_DFL;
        if (is_ours(&present) || (!first && !is_default)) {
            continue;
        }
        earlier[i] = present;
        action.sa_mask = present.sa_mask;
        action.sa_flags = SA_SIGINFO | SA_ONSTACK | (present.sa_flags & (SA_NODEFER | SA_RESTART));
        sigaction(signals[i], &action, NULL);
    }
}

static pthread_key_t stacks;
static pthread_once_t stacks_made = PTHREAD_ONCE_INIT;

static void free_stack(void *stack) {
    stack_t present;

    if (sigaltstack(NULL, &present) == 0 && present.ss_sp == stack) {
        const stack_t none = {.ss_flags = SS_DISABLE};
        sigaltstack(&none, NULL);
    }
    munmap(stack, HANDLER_STACK);
}

static void make_key_of_stacks(void) {
    pthread_key_create(&stacks, free_stack);
}

void mark_prepare_thread(void) {
    stack_t present;

    pthread_once(&stacks_made, make_key_of_stacks);
    if (sigaltstack(NULL, &present) != 0 || !(present.ss_flags & SS_DISABLE)) {
        return;
    }
    void *memory = mmap(NULL, HANDLER_STACK, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS,
                        -1, 0);
    const stack_t stack = {.ss_sp = memory, .ss_size = HANDLER_STACK};
    if (memory != MAP_FAILED && (sigaltstack(&stack, NULL) != 0 ||
                                 pthread_setspecific(stacks, memory) != 0)) {
        free_stack(memory);
    }
}

static void prepare_process(void) {
    static bool prepared;

    mutex_lock(&lock);
    if (!prepared) {
        atexit(on_exit_of_process);
    }
    install(!prepared);
    prepared = true;
    mutex_unlock(&lock);
}

bool mark_open(Mark *mark, int file) {
    void *page = mmap(NULL, PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);

    if (page == MAP_FAILED) {
        return false;
    }
    madvise(page, PAGE, MADV_DONTFORK); /* or else a fork would hold the lock of the file */
    mark->owner = getpid();
    mark->page = page;
    prepare_process();
    mark_prepare_thread();
    return true;
}

void mark_close(Mark *mark) {
    void *page = (void *)(uintptr_t)mark->page;

    mark->page = NULL;
    if (page != NULL && mark->owner == getpid()) {
        munmap(page, PAGE);
    }
}

void mark_forgive(const Mark *mark) {
    if (mark != NULL && mark->page != NULL && mark->owner == getpid()) {
        mark->page[0] = 0;
    }
}

#else

void mark_prepare_thread(void) {
}

bool mark_open(Mark *mark, int file) {
    (void)mark;
    (void)file;
    errno = ENOSYS;
    return false;
}

void mark_close(Mark *mark) {
    (void)mark;
}

void mark_forgive(const Mark *mark) {
    (void)mark;
}

#endif
