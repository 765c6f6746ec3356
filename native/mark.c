#include "mark.h"

#include <errno.h>
#include <stddef.h>

volatile int mark_struck;

#if defined __linux__

#include <pthread.h>
#include <signal.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

enum { PAGE = 4096, HANDLER_STACK = 64 << 10 };

/* The open marks. A signal handler reads this without a lock, so places are set one by one. */
enum { MOST_OPEN = 64 };
static Mark *volatile open_marks[MOST_OPEN];
static pthread_mutex_t opening = PTHREAD_MUTEX_INITIALIZER;

/* Puts a mark into the place of another one, if there is such a place. */
static void replace_open(Mark *old, Mark *new) {
    pthread_mutex_lock(&opening);
    for (int i = 0; i < MOST_OPEN; i++) {
        if (open_marks[i] == old) {
            open_marks[i] = new;
            break;
        }
    }
    pthread_mutex_unlock(&opening);
}

void mark_all(int number, const char *text) {
    for (int i = 0; i < MOST_OPEN; i++) {
        const Mark *mark = open_marks[i];
        if (mark == NULL || mark->page == NULL || mark->owner != getpid()) {
            continue;
        }
        for (int j = 0; j < MARK_TEXT && text[j] != 0; j++) {
            mark->page[MARK_TEXT + j] = (unsigned char)text[j];
        }
        mark->page[1] = NO_CALL;
        mark->page[0] = (unsigned char)number;
        mark_struck = 1;
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

bool mark_open(Mark *mark, int file) {
    void *page = mmap(NULL, PAGE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);

    if (page == MAP_FAILED) {
        return false;
    }
    madvise(page, PAGE, MADV_DONTFORK); /* or else a fork would hold the lock of the file */
    mark->owner = getpid();
    mark->page = page;
    replace_open(NULL, mark);
    mark_prepare_thread();
    return true;
}

void mark_close(Mark *mark) {
    void *page = (void *)(uintptr_t)mark->page;

    if (page != NULL) {
        replace_open(mark, NULL);
    }
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

void mark_all(int number, const char *text) {
    (void)number;
    (void)text;
}

void mark_forgive(const Mark *mark) {
    (void)mark;
}

#endif
