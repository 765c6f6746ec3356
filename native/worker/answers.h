/* Answers to requests, and messages that come before them. */

#ifndef FMUGYM_ANSWERS_H
#define FMUGYM_ANSWERS_H

#include "worker.h"

void send_done(void);
/* Frees what the writer has. */
void send_result(Writer *writer);
void send_error(const char *text);
/* Sends why the last status of an instance was bad, as an error. */
void send_failure(Worker *worker, size_t index);
/* Whether there is a failure is the first byte. */
void write_failure(Worker *worker, Writer *writer, size_t index);

/* The answers to requests for snapshots and for states as values; see saving.c. */
void answer_save(Worker *worker, Reader *reader);
void answer_restore(Worker *worker, Reader *reader);
void answer_save_states(Worker *worker, Reader *reader);
void answer_restore_states(Worker *worker, Reader *reader);

#endif
