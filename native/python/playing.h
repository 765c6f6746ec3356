/* What is prepared for playing. For the files that prepare it and that play. */

#ifndef FMUGYM_PLAYING_H
#define FMUGYM_PLAYING_H

#include "pool/play_form.h"
#include "pool/player.h"
#include "python/programs.h"
#include "python/results.h"

enum {
    STARTS,
    STREAMS,
    ENDED,
    CURRENT, /* the actions of a step, and of the one before */
    PREVIOUS,
    KEPT,
    PLAY_BUFFERS
};

/* The result of prepare_play, which the next call replaces as a whole. */
typedef struct {
    PlayForm form;
    PyRows rows;
    Py_buffer buffers[PLAY_BUFFERS];
    Item action_item;
    PyObject *start; /* the Access of the variables set before initialization */
    PyObject *draws;
    Results results;
} Playing;

/* Of a capsule that prepare_play has made. */
Playing *playing_of(PyObject *capsule);

#endif
