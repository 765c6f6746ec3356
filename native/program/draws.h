/* Drawing from distributions as fmugym/environment/distributions.py does with a generator of numpy: the same
 * numbers of the stream make the same values, to the last bit. */

#ifndef FMUGYM_DRAWS_H
#define FMUGYM_DRAWS_H

#include <stdbool.h>

#include "program/streams.h"

/* Each kind is named with its numbers. */
#define DISTRIBUTIONS(X)                                                                           \
    X(UNIFORM, "uniform", 2)         /* lower end, width */                                        \
    X(LOG_UNIFORM, "log_uniform", 2) /* the same of the logarithm */                               \
    X(NORMAL, "normal", 4)           /* mean, standard deviation, limits */                        \
    X(CHOICE, "choice", 1)           /* the values, at least one */                                \
    X(SAME_ROW, "same_row", 1)       /* as many values, of which that at the place of the choice   \
                                        or same_row before is taken */                             \
    X(WEIGHTED, "weighted", 2)       /* as many cumulated probabilities, then the values */

#define ENUMERATE(kind, name, numbers) KIND_##kind,
typedef enum { DISTRIBUTIONS(ENUMERATE) NUMBER_OF_KINDS } Kind;
#undef ENUMERATE

extern const char *const kind_names[NUMBER_OF_KINDS];

/* The bit generator of numpy/random/bitgen.h. */
typedef struct {
    void *state;
    uint64_t (*next_uint64)(void *state);
    uint32_t (*next_uint32)(void *state);
    double (*next_double)(void *state);
    uint64_t (*next_raw)(void *state);
} BitGenerator;

/* numpy's function random_standard_normal. */
typedef double StandardNormal(BitGenerator *bits);

/* The function exp behind Python's math.exp. A compiler may bring another, which rounds otherwise. */
typedef double Exponential(double x);

typedef struct {
    int64_t kind;
    int64_t row;          /* the row of the start value that it sets, or -1 */
    int64_t first, count; /* where its numbers are */
} Draw;

/* The draws of an episode, in their order. */
typedef struct {
    size_t count;
    const Draw *draws;
    const double *numbers;
    StandardNormal *standard_normal; /* NULL if there is no normal distribution */
    Exponential *exponential;        /* NULL if there is no log-uniform distribution */
} Draws;

/* Whether the kinds are known and have the numbers that they need. */
bool draws_are_sound(const Draws *draws, size_t number_of_numbers);
/* Whether all rows are below this number. */
bool draws_fit(const Draws *draws, size_t rows);

/* The bit generator whose numbers are those of a stream. */
BitGenerator bits_of(Stream *stream);

/* Draws the values of an episode, which lie stride values apart. */
void draws_take(const Draws *draws, BitGenerator *bits, double *values, size_t stride);

/* Sets the start values among the values of an episode, all of which lie stride values apart. */
void draws_start(const Draws *draws, const double *values, double *start_values, size_t stride);

#endif
