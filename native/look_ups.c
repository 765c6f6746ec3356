#include "operations.h"

#include <math.h>
#include <string.h>

#include "platform.h"

/* Negative indices count from the end. One outside of the table reads its first value. */
void operation_take(const Table *table, const int64_t *indices, size_t count, char *to,
                    Notes *notes) {
    const int64_t length = (int64_t)table->length;

    for (size_t j = 0; j < count; j++) {
        int64_t index = indices[j] < 0 ? indices[j] + length : indices[j];
        if (index < 0 || index >= length) {
            notes->outside = true;
            index = 0;
        }
        memcpy(to + j * table->size, table->data + (size_t)index * table->size,
               table->size);
    }
}

enum { FEW_POINTS = 16 /* so many are compared with x one after the other */ };

/* The points of an interpolation, and the values on both sides of them. */
typedef struct {
    size_t count;
    const double *xs, *ys;
    double left, right;
} Points;

static Points points_of(const Table *table) {
    const double *values = (const double *)(const void *)table->data;
    const size_t count = table->length / 2 - 1;

    return (Points){count, values, values + count, values[2 * count], values[2 * count + 1]};
}

/* For each x the index of the last of so many coordinates that is not greater; 0 if there is none.
 * The number of coordinates is halved without branches, which the processor could not predict. */
static void search_places(const double *x, size_t count, Points p, int64_t *places) {
    for (size_t j = 0; j < count; j++) {
        size_t low = 0;
        for (size_t left = p.count; left > 1; left -= left / 2) {
            low += p.xs[low + left / 2] <= x[j] ? left / 2 : 0;
        }
        places[j] = (int64_t)low;
    }
}

/* The same for few coordinates. */
WIDE static void count_places(const double *restrict x, size_t count, Points p,
                              int64_t *restrict places) {
    for (size_t j = 0; j < count; j++) {
        places[j] = 0;
    }
    for (size_t i = 1; i < p.count; i++) {
        const double coordinate = p.xs[i];
        for (size_t j = 0; j < count; j++) {
            places[j] += coordinate <= x[j];
        }
    }
}

/* Whether this is the place of x, if coordinates never fall. */
static bool is_place(double x, Points p, size_t place) {
    return (p.xs[place] <= x || place == 0) && (place + 1 == p.count || !(p.xs[place + 1] <= x));
}

/* The same for coordinates that never fall. Most tables have points at equal distances, or two
 * points at each, so that the place is near to where it would be then. */
static void guess_places(const double *x, size_t count, Points p, int64_t *places) {
    const size_t last = p.count - 1;
    const double density = (double)last / (p.xs[last] - p.xs[0]);

    for (size_t j = 0; j < count; j++) {
        const double guess = (x[j] - p.xs[0]) * density;
        size_t place = guess > 0.0 ? guess < (double)last ? (size_t)guess : last : 0;
        for (int i = 0; i < 2; i++) {
            place -= place > 0 && p.xs[place] > x[j];
            place += place < last && p.xs[place + 1] <= x[j];
        }
        places[j] = (int64_t)place;
        if (!is_place(x[j], p, place)) {
            search_places(&x[j], 1, p, &places[j]);
        }
    }
}

/* The arithmetic of numpy.interp, except where the result is NaN. */
WIDE static void interpolate_between(const double *restrict x, size_t count, Points p,
                                     const int64_t *restrict places, double *restrict to) {
    const int64_t last = (int64_t)p.count - 1;
    const int64_t most = last > 0 ? last - 1 : 0; /* the first of two points */
    const double first_x = p.xs[0], last_x = p.xs[last], last_y = p.ys[last];

    for (size_t j = 0; j < count; j++) {
        const int64_t place = places[j] < most ? places[j] : most;
        const double x0 = p.xs[place], y0 = p.ys[place];
        const double slope = (p.ys[place + 1] - y0) / (p.xs[place + 1] - x0);
        const double y = slope * (x[j] - x0) + y0;
        const double inside = places[j] == last ? last_y : x0 == x[j] ? y0 : y;
        to[j] = x[j] < first_x ? p.left : x[j] > last_x ? p.right : inside;
    }
}

WIDE static bool is_any_nan(const double *values, size_t count) {
    int64_t any = 0; /* as wide as the values, so that the compiler can vectorize */

    for (size_t j = 0; j < count; j++) {
        any |= values[j] != values[j];
    }
    return any != 0;
}

/* What numpy.interp tries if its result y is NaN. */
static double mended(double x, double y, Points p, size_t place) {
    const double *xs = p.xs + place, *ys = p.ys + place;

    if (isnan(x)) {
        return x;
    }
    if (x < p.xs[0] || x > p.xs[p.count - 1] || place == p.count - 1 || xs[0] == x) {
        return y; /* it is the value of a point, or on one of the sides */
    }
    const double slope = (ys[1] - ys[0]) / (xs[1] - xs[0]);
    const double other = slope * (x - xs[1]) + ys[1];
    return isnan(other) && ys[0] == ys[1] ? ys[0] : other;
}

static void mend_all(const double *x, size_t count, Points p, const int64_t *places, double *to) {
    for (size_t j = 0; j < count; j++) {
        if (isnan(to[j])) {
            to[j] = mended(x[j], to[j], p, (size_t)places[j]);
        }
    }
}

void operation_interpolate(const Table *table, const double *x, size_t count, double *to) {
    const Points p = points_of(table);
    int64_t places[PROGRAM_WIDTH];

    if (table->rising && p.count <= FEW_POINTS) {
        count_places(x, count, p, places);
    } else if (table->rising) {
        guess_places(x, count, p, places);
    } else {
        search_places(x, count, p, places);
    }
    interpolate_between(x, count, p, places, to);
    if (is_any_nan(to, count)) {
        mend_all(x, count, p, places, to);
    }
}
