/* When a clock ticks next. */

#include "model_exchange/clock.h"

/* The largest part of a fraction, of which doubles hold a few exactly. */
static const int64_t MOST = (int64_t)1 << 52;

bool interval_of(uint64_t counter, uint64_t resolution, Interval *interval) {
    if (resolution == 0 || resolution > (uint64_t)MOST || counter > (uint64_t)MOST) {
        return false;
    }
    *interval = (Interval){(double)counter / (double)resolution, (int64_t)counter,
                           (int64_t)resolution};
    return true;
}

double ticks_next(const Ticks *ticks) {
    const Interval *interval = &ticks->interval;

    return interval->resolution > 0
               ? ticks->origin + (double)ticks->passed / (double)interval->resolution
               : ticks->origin + (double)ticks->passed * interval->seconds;
}

void ticks_advance(Ticks *ticks) {
    ticks->passed += ticks->interval.resolution > 0 ? ticks->interval.counter : 1;
    if (ticks->passed > MOST) {
        ticks->origin = ticks_next(ticks);
        ticks->passed = 0;
    }
}

static int64_t common_divisor(int64_t a, int64_t b) {
    while (b != 0) {
        const int64_t rest = a % b;
        a = b;
        b = rest;
    }
    return a;
}

/* Goes over to a resolution that both intervals have in common, unless the numbers get too large. */
static bool change_exactly(Ticks *ticks, Interval interval) {
    const int64_t a = ticks->interval.resolution, b = interval.resolution;

    if (a == 0 || b == 0) {
        return false;
    }
    const int64_t divisor = common_divisor(a, b), by = b / divisor, other_by = a / divisor;
    if (a > MOST / by || ticks->passed > MOST / by || interval.counter > MOST / other_by) {
        return false;
    }
    ticks->passed *= by;
    ticks->interval = (Interval){interval.seconds, interval.counter * other_by, a * by};
    return true;
}

void ticks_change(Ticks *ticks, Interval interval) {
    if (!change_exactly(ticks, interval)) {
        ticks->origin = ticks_next(ticks);
        ticks->interval = interval;
        ticks->passed = 0;
    }
}
