/* What is prepared for playing. For the files that prepare it and that play. */

#ifndef FMUGYM_PLAYING_H
#define FMUGYM_PLAYING_H

#include "pool/play_form.h"
#include "pool/player.h"
#include "python/python.h"
#include "python/results.h"

/* The result of prepare_play, which the next call replaces as a whole. */
typedef struct {
    PyObject *args; /* of prepare_play: all arrays and forms that the rest refers to */
    PlayForm form;
    Row *rows;
    Draws draws;
    const Access *start; /* the variables set before initialization */
    Matrix start_values;
    PyArrayObject *actions; /* the memory for those of a step, whose type and shape actions have */
    Results results;
} Playing;

/* Of a capsule that prepare_play has made. */
Playing *playing_of(PyObject *capsule);

#endif
