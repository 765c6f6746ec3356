#include "mark.h"

#include <errno.h>
#include <stddef.h>

volatile int mark_struck;

#if defined __linux__

#include <pthread.h>
#include <signal.h>
#include <sys/mman.h>
#include <unistd.h>

enum { PAGE = 4096, HANDLER_STACK = 64 << 10 };

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

bool mark_open(Mark *mark, int file) {
    void *page = mmap(NULL, PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);

    if (page == MAP_FAILED) {
        return false;
    }
    madvise(page, PAGE, MADV_DONTFORK); /* or else a fork would hold the lock of the file */
    mark->owner = getpid();
    mark->page = page;
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
