/* The worker program for Windows libraries, which runs in Wine: the native pool without Python.
 *
 * It answers requests that come on the standard input until one is to close, or the other end is
 * gone. Answers go to the standard output, and what the FMU prints to the standard error. */

#include <stdio.h>
#include <stdlib.h>

#include "worker.h"

/* Tells what has ended the process; Windows would open a dialogue, Wine a debugger. */
static LONG WINAPI tell_of_fault(EXCEPTION_POINTERS *fault) {
    const DWORD code = fault->ExceptionRecord->ExceptionCode;

    send_content(CODE_FAULT, &code, sizeof code);
    TerminateProcess(GetCurrentProcess(), code);
    return EXCEPTION_EXECUTE_HANDLER;
}

static bool answer(Worker *worker, char code) {
    char *bytes;
    size_t size;
    bool goes_on = true;

    if (!receive_content(&bytes, &size)) {
        return false;
    }
    Reader reader = {bytes, bytes + size, true};
    if (code == CODE_RELEASE) {
        worker_release(worker, &reader);
    } else {
        goes_on = worker_answer(worker, &reader);
    }
    free(bytes);
    return goes_on;
}

static bool serve(Worker *worker, char code) {
    if (code != CODE_STEP && code != CODE_STEP_SOME) {
        return answer(worker, code);
    }
    worker_step(worker, code == CODE_STEP_SOME);
    return true;
}

/* The content of the first request stays: the pool's settings point to it. */
static bool open_worker(Worker *worker) {
    char code, *bytes, error[8192];
    size_t size;

    if (!receive_code(&code) || !receive_content(&bytes, &size)) {
        return false;
    }
    Reader reader = {bytes, bytes + size, true};
    const bool opened = worker_open(worker, &reader, error, sizeof error);
    worker_report(worker);
    if (opened) {
        return send_content(CODE_RESULT, NULL, 0);
    }
    Writer writer = {.bytes = NULL};
    write_bytes(&writer, "\0", 1);
    write_text(&writer, error);
    send_content(CODE_ERROR, writer.bytes, writer.size);
    return false;
}

int main(void) {
    static Worker worker; /* the settings point into it */
    char code;

    SetErrorMode(SEM_FAILCRITICALERRORS | SEM_NOGPFAULTERRORBOX);
    SetUnhandledExceptionFilter(tell_of_fault);
    if (!frames_open()) {
        fprintf(stderr, "the worker has no standard streams\n");
        return 1;
    }
    pool_prepare_process();
    if (!open_worker(&worker)) {
        return 0;
    }
    while (receive_code(&code) && serve(&worker, code)) {
    }
    return 0;
}
