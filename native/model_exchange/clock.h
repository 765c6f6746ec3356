/* The clocks of an FMU of FMI 3.0: they tick in event mode, and some variables may be set only then.
 *
 * For the solver, which enters event mode when a clock is due: solver.h. */

#ifndef FMUGYM_CLOCK_H
#define FMUGYM_CLOCK_H

#include "fmi/exchange.h"
#include "fmi/fmi.h"

struct Solver;

/* FMI's interval variabilities; the last one has two kinds here. fmugym/fmi/variable.py lists
 * their names in this order. */
typedef enum {
    CLOCK_CONSTANT,
    CLOCK_FIXED,
    CLOCK_CALCULATED,
    CLOCK_TUNABLE,
    CLOCK_CHANGING,
    CLOCK_COUNTDOWN,
    CLOCK_TRIGGERED, /* an input: ticks when the pool's owner sets it */
    CLOCK_OUTPUT     /* ticks when the FMU wants it to */
} ClockKind;

/* A time between two ticks, or before the first one. */
typedef struct {
    double seconds;              /* NaN if the FMU has to be asked */
    int64_t counter, resolution; /* their ratio is the same time, exactly; 0 if it is no fraction */
} Interval;

typedef struct Clock {
    uint32_t reference, kind;
    Interval interval, shift;
    int64_t by_fractions; /* whether the FMU takes and tells these times as fractions */
} Clock;

#define NO_CLOCK UINT32_MAX

/* An input that may be set only while a clock ticks. One with several clocks is there once for
 * each. Arrays that may be set at any time are there, too, without a clock. */
typedef struct Clocked {
    uint32_t reference, clock; /* the latter is an index, or NO_CLOCK */
    uint32_t size;             /* the number of values */
} Clocked;

/* What is kept of a clock, and saved with the state. Its next tick is so many intervals after the
 * origin: a sum of intervals would drift. */
typedef struct {
    double origin;
    Interval interval;
    int64_t passed; /* intervals; with a fraction, parts of a second that its resolution gives */
    int64_t ticked; /* whether it ticked in the last communication step, or at the start */
} Ticks;

/* ticks.c: the time of the next tick; the tick after it. A new interval begins with the next tick. */
double ticks_next(const Ticks *ticks);
void ticks_advance(Ticks *ticks);
void ticks_change(Ticks *ticks, Interval interval);
/* Makes an interval of a fraction. Returns false if it is none, or its parts are too large. */
bool interval_of(uint64_t counter, uint64_t resolution, Interval *interval);

/* To be called in initialization mode: sets or asks for intervals, and plans the first ticks. */
Status clocks_prepare(struct Solver *me);
/* Forgets what ticked in the last communication step. */
void clocks_begin_step(struct Solver *me);
/* The following three are for event mode: before the first update of the discrete states, before
 * each, and after the last. The first lets the clocks tick that are due or asked for. */
Status clocks_activate(struct Solver *me);
Status clocks_watch(struct Solver *me);
Status clocks_plan(struct Solver *me);
/* The time of the next tick; infinite if there is none. */
double clocks_next(const struct Solver *me);

/* Lets an input clock tick in the next event; whether each clock of the references ticked. Clocks
 * that are not known are never asked for, and never tick. */
void clocks_ask(struct Solver *me, const uint32_t *references, size_t count, const bool *values);
void clocks_tell(const struct Solver *me, const uint32_t *references, size_t count, bool *values);
/* Whether the reference is that of an input with clocks. */
bool clocks_own(const struct Solver *me, uint32_t reference);

#endif
