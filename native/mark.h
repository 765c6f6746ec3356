/* Marks: pages of files in which a crash inside an FMU leaves its signal and the call.
 *
 * The file outlives the process, so a later process can read why this one ended. The signal handler
 * of crash.c writes the page. Only on Linux. */

#ifndef FMUGYM_MARK_H
#define FMUGYM_MARK_H

#include <stdbool.h>
#include <stdint.h>

/* What a thread inside a pool asks the FMU for. fmugym/pool/mark.py has names in this order. */
typedef enum {
    CALL_STEP, /* also setting its inputs and reading its outputs */
    CALL_LOAD,
    CALL_INSTANTIATE,
    CALL_INITIALIZE,
    CALL_READ,
    CALL_RESET,
    CALL_SAVE,
    CALL_RESTORE,
    CALL_FREE,
    NO_CALL, /* the process has ended elsewhere, because its heap was damaged */
    NUMBER_OF_CALLS
} FmuCall;

typedef struct {
    volatile unsigned char *page; /* the number of the signal, then that of the call */
    int64_t owner;                /* the process; a fork must not write the page */
} Mark;

enum { MARK_TEXT = 96 }; /* the place of what the C library said, a text of at most this length */
enum { MARK_EXIT = 255 }; /* in the place of a signal: the FMU has ended the process by exit */

/* Maps a page of an open file, and prepares this thread. Returns whether that
 * worked; if not, errno says why. */
bool mark_open(Mark *mark, int file);
void mark_close(Mark *mark);

/* Gives this thread a stack for signal handlers, without which a handler cannot run when the
 * FMU has used up the thread's own stack. */
void mark_prepare_thread(void);

/* Whether a signal has left a mark in this process. */
extern volatile int mark_struck;

/* Does the same to all open marks of this process; for signal handlers. The heap does not tell who
 * has damaged it. */
void mark_all(int number, const char *text);

/* Takes a mark back, because the process has survived the signal. */
void mark_forgive(const Mark *mark);

#endif
