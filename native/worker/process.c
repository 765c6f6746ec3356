/* The process of a worker, as the system sees it: its channel, its end, and a process that it traces. */

#include "worker/process.h"

#include "shared/platform.h"

#if !defined _WIN32
#include <fcntl.h>
#include <signal.h>
#include <unistd.h>
#endif
#if defined __linux__
#include <sys/prctl.h>
#include <sys/ptrace.h>
#endif

#if defined _WIN32

void channel_open(Channel *channel, long long descriptor) {
    channel->input = channel->output = (void *)(uintptr_t)descriptor;
    channel->is_socket = true;
}

static DWORD WINAPI end_after(void *parent) {
    WaitForSingleObject(parent, INFINITE);
    TerminateProcess(GetCurrentProcess(), 1);
    return 0;
}

bool process_end_with(long long parent) {
    void *process = OpenProcess(SYNCHRONIZE, FALSE, (DWORD)parent);
    void *thread = process == NULL ? NULL : CreateThread(NULL, 0, end_after, process, 0, NULL);

    SetErrorMode(SEM_FAILCRITICALERRORS | SEM_NOGPFAULTERRORBOX);
    return thread != NULL;
}

void process_let_go(int process, int stopped_by) {
    (void)process;
    (void)stopped_by;
}

#else

enum { OUT_OF_REACH = 512 };

/* Gives a file descriptor a number that FMUs do not close by mistake, if there are so many. */
static int moved(int descriptor) {
    const int copy = fcntl(descriptor, F_DUPFD_CLOEXEC, OUT_OF_REACH);

    if (copy < 0) {
        return descriptor;
    }
    close(descriptor);
    return copy;
}

void channel_open(Channel *channel, long long descriptor) {
    channel->socket = moved((int)descriptor);
}

bool process_end_with(long long parent) {
#if defined __linux__
    prctl(PR_SET_PDEATHSIG, SIGKILL, 0, 0, 0);
#endif
    return getppid() == parent;
}

/* A process that is not let go waits for its tracer, so it is ended where that is unknown. */
void process_let_go(int process, int stopped_by) {
#if defined __linux__
    ptrace(PTRACE_DETACH, process, NULL, (void *)(intptr_t)stopped_by);
#else
    (void)stopped_by;
    kill(process, SIGKILL);
#endif
}

#endif
