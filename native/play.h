/* Playing: the part of a vector environment's step that surrounds the steps of the instances. */

#ifndef FMUGYM_PLAY_H
#define FMUGYM_PLAY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "draws.h"
#include "program.h"

/* What stays the same from step to step. The owner provides all memory. */
typedef struct {
    size_t count;
    Program inputs;    /* results: the inputs */
    Program judgement; /* results: done, truncated, reward */
    Source source;     /* everything except the actions */
    int64_t lowest_action, highest_action;
    double *input_rows;
    double *start_values; /* a row for each start variable */
    const Draws *draws;
    Stream *streams; /* the random stream of each environment */
    int64_t *step_counts;
    int64_t limit;  /* steps after which an episode is truncated */
    uint8_t *ended; /* which environments start an episode instead of taking a step */
} Play;

/* One step of all environments, and where its results go. */
typedef struct {
    const Play *play;
    const int64_t *actions;
    double *rewards;
    uint8_t *terminated, *truncated;
    double *drawn; /* a row for each draw; only the values drawn in this step are written. Values
                    * that were given are read from it */
} Turn;

/* Whether an action is out of range. */
bool play_has_bad_action(const Turn *turn);

/* Scratch memory of one thread. */
typedef struct {
    Registers inputs, judgement;
} PlayScratch;

void play_open(const Turn *turn, PlayScratch *scratch);

/* Both handle a run of at most PROGRAM_WIDTH environments. The first runs before their instances
 * are reset or stepped, the second afterwards. The second returns how many episodes have just
 * ended. */
void play_prepare(const Turn *turn, size_t begin, size_t count, PlayScratch *scratch);
size_t play_judge(const Turn *turn, size_t begin, size_t count, PlayScratch *scratch);

/* For an environment that is neither reset nor stepped because memory ran out. */
void play_skip(const Turn *turn, size_t index);

/* Prefetches the memory that play_draw will use. */
void play_foresee(const Play *play, size_t index);

/* Draws the start values of an episode, before its instance is reset. */
void play_draw(const Turn *turn, size_t index);

#endif
