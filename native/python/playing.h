/* What is prepared for playing, and a turn of it. For the files that prepare it and that play. */

#ifndef FMUGYM_PLAYING_H
#define FMUGYM_PLAYING_H

#include "pool/play_form.h"
#include "pool/player.h"
#include "python/programs.h"
#include "python/results.h"

enum {
    STARTS,
    STATES,
    ENDED,
    CURRENT,
    PREVIOUS,
    KEPT,
    PLAY_BUFFERS
};

/* The result of prepare_play. It never changes; the next call replaces it as a whole. */
typedef struct {
    PlayForm form;
    PyRows rows;
    Py_buffer buffers[PLAY_BUFFERS];
    Item action_item;
    int action_dimensions;
    Py_ssize_t action_shape[MOST_DIMENSIONS + 1]; /* with the environments on the first axis */
    PyObject *start; /* the Access of the variables set before initialization */
    PyObject *draws;
    Results *results;
} Playing;

/* Of a capsule that prepare_play has made. */
Playing *playing_of(PyObject *capsule);

/* Whether the pool itself fills the observations, instead of a program. */
bool pool_observes(const Playing *playing);

/* One call that plays: */

typedef struct {
    Py_buffer actions;
    Turn turn;
    Call call;
    int64_t number; /* the action of the only environment, if it is an integer */
    bool bad_action;
    size_t troubled;
    Ends ends;
} PyTurn;

/* Takes an array of actions, or the action of the only environment: an array, or an integer. Those of
 * another type or shape come back as an exception; the caller then converts them. */
bool take_actions_of_turn(const Playing *playing, PyObject *actions, PyTurn *t);

/* Lets the turn and its call refer to what was prepared and to the actions, if there are any. */
void settle_turn(PyPool *self, const Playing *playing, PyTurn *t);

/* Whether a hook looked up an index outside of a table, which is an exception. */
bool is_outside(const PyTurn *t);

/* Returns false with an exception if nothing is prepared. */
bool is_prepared(const PyPool *self);

#endif
