/* The worker program for Windows libraries, which runs in Wine: the worker without Python.
 *
 * Requests come on the standard input. Answers go to the standard output, and what the FMU prints to
 * the standard error. */

#include "worker/worker.h"

#include <fcntl.h>
#include <io.h>
#include <stdio.h>

static Worker worker; /* the settings point into it */

/* Tells what has ended the process; Windows would open a dialogue, Wine a debugger. */
static LONG WINAPI tell_of_fault(EXCEPTION_POINTERS *fault) {
    const int64_t code = fault->ExceptionRecord->ExceptionCode;

    send_message(&worker.channel, ANSWER_FAULT, &code, sizeof code);
    TerminateProcess(GetCurrentProcess(), (UINT)code);
    return EXCEPTION_EXECUTE_HANDLER;
}

static HANDLE copy_of(DWORD stream) {
    HANDLE copy = NULL;
    const HANDLE process = GetCurrentProcess();

    DuplicateHandle(process, GetStdHandle(stream), process, &copy, 0, FALSE, DUPLICATE_SAME_ACCESS);
    return copy;
}

/* Keeps the standard streams for messages. */
static bool open_channel(Channel *channel) {
    channel->input = copy_of(STD_INPUT_HANDLE);
    channel->output = copy_of(STD_OUTPUT_HANDLE);
    const int nothing = _open("NUL", _O_RDONLY);
    _dup2(2, 1);
    _dup2(nothing, 0);
    setvbuf(stdout, NULL, _IONBF, 0); /* the next call may end the process */
    /* libraries with a C library of their own look these up */
    SetStdHandle(STD_OUTPUT_HANDLE, GetStdHandle(STD_ERROR_HANDLE));
    SetStdHandle(STD_INPUT_HANDLE, (HANDLE)_get_osfhandle(nothing));
    return channel->input != NULL && channel->output != NULL;
}

int main(void) {
    SetErrorMode(SEM_FAILCRITICALERRORS | SEM_NOGPFAULTERRORBOX);
    SetUnhandledExceptionFilter(tell_of_fault);
    if (!open_channel(&worker.channel)) {
        fprintf(stderr, "the worker has no standard streams\n");
        return 1;
    }
    pool_prepare_process();
    worker_serve(&worker);
    return 0;
}
