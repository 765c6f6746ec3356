/* Instructions of programs that look up values in tables and interpolate. */

#include "program/operations.h"

#include <math.h>
#include <string.h>

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

/* Whether this is the index of the last coordinate that is not greater than x. */
static bool is_place(double x, Points p, size_t place) {
    return p.xs[place] <= x && (place + 1 == p.count || !(p.xs[place + 1] <= x));
}

/* The number of coordinates is halved without branches, which the processor could not predict. */
static size_t search_place(double x, Points p) {
    size_t low = 0;

    for (size_t left = p.count; left > 1; left -= left / 2) {
        low += p.xs[low + left / 2] <= x ? left / 2 : 0;
    }
    return low;
}

/* Most tables have points at equal distances, or two points at each, so that the place is near to
 * where it would be then. */
static size_t find_place(double x, Points p) {
    const size_t last = p.count - 1;
    const double guess = (x - p.xs[0]) * ((double)last / (p.xs[last] - p.xs[0]));
    size_t place = guess > 0.0 ? guess < (double)last ? (size_t)guess : last : 0;

    for (int i = 0; i < 2; i++) {
        place -= place > 0 && p.xs[place] > x;
        place += place < last && p.xs[place + 1] <= x;
    }
    return is_place(x, p, place) ? place : search_place(x, p);
}

/* The arithmetic of numpy.interp between two points, of which one may be infinite. */
static double between(double x, const double *xs, const double *ys) {
    const double slope = (ys[1] - ys[0]) / (xs[1] - xs[0]);
    const double y = slope * (x - xs[0]) + ys[0], other = slope * (x - xs[1]) + ys[1];

    if (y == y) {
        return y;
    }
    return isnan(other) && ys[0] == ys[1] ? ys[0] : other;
}

static double interpolated(double x, Points p) {
    const size_t last = p.count - 1;

    if (isnan(x) && last > 0) { /* of a single point numpy makes its value */
        return x;
    }
    if (x < p.xs[0] || x > p.xs[last]) {
        return x < p.xs[0] ? p.left : p.right;
    }
    const size_t place = find_place(x, p);
    return place == last || p.xs[place] == x ? p.ys[place]
                                             : between(x, p.xs + place, p.ys + place);
}

void operation_interpolate(const Table *table, const double *x, size_t count, double *to) {
    const Points p = points_of(table);

    for (size_t j = 0; j < count; j++) {
        to[j] = interpolated(x[j], p);
    }
}
