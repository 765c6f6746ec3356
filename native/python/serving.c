/* The functions of the module that make a process a worker: see worker/worker.h. */

#include <stdio.h>
#include <stdlib.h>

#include "python/programs.h"

#include "worker/worker.h"

#if !defined _WIN32
#include <signal.h>
#endif
#if defined __linux__
#include <sys/prctl.h>
#include <sys/ptrace.h>
#endif
#if !defined _WIN32
#include <fcntl.h>
#include <unistd.h>

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
#endif

static void open_channel(Channel *channel, long long descriptor) {
#if defined _WIN32
    channel->input = channel->output = (void *)(uintptr_t)descriptor;
    channel->is_socket = true;
#else
    channel->socket = moved((int)descriptor);
#endif
}

/* The worker is never freed: the process ends when it is done. */
PyObject *py_serve(PyObject *module, PyObject *args) {
    long long descriptor;
    int memory;
    Worker *worker = calloc(1, sizeof *worker);

    (void)module;
    if (worker == NULL) {
        return PyErr_NoMemory();
    }
    if (!PyArg_ParseTuple(args, "Li:serve", &descriptor, &memory)) {
        free(worker);
        return NULL;
    }
    open_channel(&worker->channel, descriptor);
    worker->memory = memory;
    setvbuf(stdout, NULL, _IOLBF, BUFSIZ); /* a crash would lose what is buffered */
    Py_BEGIN_ALLOW_THREADS worker_serve(worker);
    fflush(NULL); /* a line without an end */
    Py_END_ALLOW_THREADS Py_RETURN_NONE;
}

#if defined _WIN32

static DWORD WINAPI end_after(void *parent) {
    WaitForSingleObject(parent, INFINITE);
    TerminateProcess(GetCurrentProcess(), 1);
    return 0;
}

static bool end_with(long long parent) {
    void *process = OpenProcess(SYNCHRONIZE, FALSE, (DWORD)parent);
    void *thread = process == NULL ? NULL : CreateThread(NULL, 0, end_after, process, 0, NULL);

    SetErrorMode(SEM_FAILCRITICALERRORS | SEM_NOGPFAULTERRORBOX);
    return thread != NULL;
}

#else

static bool end_with(long long parent) {
#if defined __linux__
    prctl(PR_SET_PDEATHSIG, SIGKILL, 0, 0, 0);
#endif
    return getppid() == parent;
}

#endif

PyObject *py_end_with(PyObject *module, PyObject *number) {
    const long long parent = PyLong_AsLongLong(number);

    (void)module;
    return PyErr_Occurred() ? NULL : PyBool_FromLong(end_with(parent));
}

/* A process that is not let go waits for its tracer, so it is ended where that is unknown. */
PyObject *py_stop_tracing(PyObject *module, PyObject *args) {
    int process, stopped_by;

    (void)module;
    if (!PyArg_ParseTuple(args, "ii:stop_tracing", &process, &stopped_by)) {
        return NULL;
    }
#if defined __linux__
    ptrace(PTRACE_DETACH, process, NULL, (void *)(intptr_t)stopped_by);
#elif !defined _WIN32
    kill(process, SIGKILL);
#endif
    Py_RETURN_NONE;
}
