/* The handler of the signals by which a process ends if its code goes wrong. */

#include "crash.h"

#if defined __linux__

#include <dlfcn.h>
#include <errno.h>
#include <signal.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "inside.h"
#include "platform.h"

static const int signals[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT};
enum { SIGNALS = sizeof signals / sizeof *signals };

static struct sigaction earlier[SIGNALS];
static Mutex lock = MUTEX_INITIALIZER;

/* Where glibc leaves the reason before it aborts; debuggers read it. NULL in other C libraries. */
typedef struct {
    unsigned size;
    char text[];
} AbortMessage;
static AbortMessage **abort_message;

/* The functions of this part run in signal handlers. They neither lock nor allocate. */

/* What the C library said if it has aborted because the heap is damaged, or NULL. */
static const char *heap_damage(void) {
    static const char *const beginnings[] = {"free(): ",       "malloc(): ",    "realloc(): ",
                                             "malloc_consol",  "munmap_chunk()", "mremap_chunk()",
                                             "corrupted ",     "double free or", "tcache_thread",
                                             "unaligned tcac", "unaligned fast", "sysmalloc"};
    const AbortMessage *said = abort_message == NULL ? NULL : *abort_message;

    for (size_t i = 0; said != NULL && i < sizeof beginnings / sizeof *beginnings; i++) {
        if (strncmp(said->text, beginnings[i], strlen(beginnings[i])) == 0) {
            return said->text;
        }
    }
    return NULL;
}

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
        const char *damage = number == SIGABRT && inside_mark() == NULL ? heap_damage() : NULL;
        strike((unsigned char)number);
        if (damage != NULL) {
            mark_all(number, damage);
        }
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

void crash_watch(void) {
    static bool prepared;

    mutex_lock(&lock);
    if (!prepared) {
        abort_message = (AbortMessage **)dlsym(RTLD_DEFAULT, "__abort_msg");
        atexit(on_exit_of_process);
    }
    install(!prepared);
    prepared = true;
    mutex_unlock(&lock);
}

#else

void crash_watch(void) {
}

#endif
