/* Playing: the part of a vector environment's step that surrounds the steps of the instances. */

#ifndef FMUGYM_PLAY_H
#define FMUGYM_PLAY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "program/draws.h"
#include "program/program.h"

/* What step() refuses: integers outside of a range, or floats that are NaN. */
typedef enum {
    ACTIONS_ANY,
    ACTIONS_IN_RANGE,
    ACTIONS_FLOAT64,
    ACTIONS_FLOAT32
} ActionCheck;

/* The actions of one environment follow each other in memory. */
typedef struct {
    size_t elements, size; /* of one environment; bytes of an element */
    ActionCheck check;
    int64_t lowest, highest;
    char *current, *previous; /* those of this step and of the step before */
    const char *none;         /* what counts as the action of an episode that starts */
} Actions;

/* Keeps a row as it was before the step. */
typedef struct {
    Row from, to;
} RowCopy;

typedef struct {
    const RowCopy *rows;
    size_t count;
} RowCopies;

/* Value of a row where an episode starts. */
typedef enum { START_CONSTANT, START_ROW, START_DRAW } StartKind;

typedef struct {
    Row to;
    StartKind kind;
    union {
        uint64_t bits;    /* of a constant, in the first bytes */
        const char *row;  /* of values of the same size */
        size_t draw;      /* the number of a draw */
    } from;
} RowStart;

/* Rows and their values where an episode starts, in the order in which they are filled. */
typedef struct {
    const RowStart *rows;
    size_t count;
} RowStarts;

/* After the arrays of observations and infos, a step fills these: */
enum { REWARDS_ARRAY, TERMINATED_ARRAY, TRUNCATED_ARRAY, STEP_ARRAYS };

/* What stays the same from step to step. The owner provides all memory. */
typedef struct {
    size_t count;
    Program inputs;    /* stores the inputs, and counts the step */
    Program conclusion; /* stores the rest: episode variables, results, which episodes have ended */
    Program observation; /* stores the observations and infos of episodes that start */
    Source source;     /* only the statuses; each step sets the rest */
    size_t number_of_arrays; /* that each call brings: */
    size_t number_of_seen;   /* those of observations and infos are the first ones */
    size_t array_sizes[MOST_ARRAYS]; /* bytes of one environment in each of them */
    Actions actions;
    const double *output_rows;
    double *kept_rows; /* the outputs before the step */
    size_t number_of_outputs;
    bool reads_kept; /* whether the conclusion reads them */
    RowCopies before_inputs;    /* what the program of the inputs is going to replace */
    RowCopies before_conclusion; /* the episode variables */
    RowStarts starts;
    RowStarts unstepped; /* what the conclusion stores where an episode starts instead of a step */
    double *start_values; /* a row for each start variable */
    const Draws *draws;
    Stream *streams; /* the random stream of each environment */
    uint8_t *ended; /* which environments start an episode instead of taking a step */
} Play;

/* One step of all environments, and where its results go. */
typedef struct Turn {
    const Play *play;
    const char *actions;
    char *const *arrays;
    char *const *last; /* observations and infos of episodes that end, where others start at once */
    uint8_t *started;  /* where they have started; NULL if they start in the next step */
    double *drawn; /* a row for each draw; only the values drawn in this step are written */
} Turn;

/* Whether an action is out of range or NaN. */
bool play_has_bad_action(const Turn *turn);

/* Scratch memory of one thread. */
typedef struct {
    Register memory[PROGRAM_REGISTERS]; /* of one program at a time */
    Registers inputs, conclusion, observation;
} PlayScratch;

/* What became of a run. */
typedef struct {
    size_t ended;    /* episodes that have just ended */
    size_t troubled; /* environments with numbers that are not finite */
    uint8_t not_finite[PROGRAM_WIDTH]; /* which of the latest run have such results */
    bool outside;    /* whether a hook looked up an index outside of a table */
} Verdict;

void play_open(const Turn *turn, PlayScratch *scratch);

/* Some environments of a run. */
typedef struct {
    size_t count;
    uint32_t places[PROGRAM_WIDTH];
} Listed;

/* Lists the environments of a run whose episodes have ended: they start the next one instead of a step. */
void play_list_ended(const Play *play, size_t begin, size_t count, Listed *ended);

/* Both handle a run of at most PROGRAM_WIDTH environments, before and after their instances are reset
 * or stepped. */
void play_prepare(const Turn *turn, size_t begin, size_t count, PlayScratch *scratch);
void play_conclude(const Turn *turn, size_t begin, size_t count, const Fresh *fresh,
                   const Listed *starting, PlayScratch *scratch, Verdict *verdict);

/* Stores the observations and infos of environments outside of a step or after a start, at most
 * PROGRAM_WIDTH of them. */
void play_observe(const Turn *turn, size_t begin, size_t count, PlayScratch *scratch,
                  Verdict *verdict);

/* Keeps so many outputs of a run, from the first of them on, before the new ones replace them. */
void play_keep_outputs(const Play *play, size_t first, size_t number, size_t begin, size_t count);

/* Sets what programs and hooks read at the start of the listed environments' episodes: actions, and the
 * rows of starts. */
void play_start_episodes(const Turn *turn, const uint32_t *starting, size_t count);

/* Writes zeros as the results of an environment that is neither reset nor stepped, because memory ran
 * out. */
void play_skip(const Turn *turn, size_t index);

/* Prefetches the memory that play_draw will use. */
void play_foresee(const Play *play, size_t index);

/* Draws the start values of an episode, before its instance is reset. */
void play_draw(const Turn *turn, size_t index);

#endif
