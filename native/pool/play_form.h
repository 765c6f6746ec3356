/* The form of a play: what surrounds the steps of a vector environment. fmugym/pool/play_form.py writes it. */

#ifndef FMUGYM_PLAY_FORM_H
#define FMUGYM_PLAY_FORM_H

#include "pool/play.h"
#include "pool/pool.h"
#include "program/program_form.h"

/* A play, and the memory that belongs to it. */
typedef struct {
    Play play;
    ProgramForm inputs, conclusion, observation;
    char *form;         /* a copy of it, which the play points to */
    RowCopy *before_inputs, *before_conclusion;
    RowStart *starts, *unstepped;
    bool pool_observes; /* whether the pool itself fills the observations, instead of a program */
} PlayForm;

/* Reads the form of a play, which names rows by their numbers among these. The caller has set the
 * draws, if there are any. Returns what is wrong, or NULL. The caller must drop the play in any case. */
const char *play_take(PlayForm *p, const Settings *settings, const void *form, size_t size,
                      const Row *rows, size_t number_of_rows);
/* Lets a play use the outputs and statuses of a pool, and memory of its owner: the outputs before a
 * step, and which episodes have ended. */
void play_settle(PlayForm *p, const Settings *settings, double *kept, uint8_t *ended);
void play_drop(PlayForm *p);

#endif
