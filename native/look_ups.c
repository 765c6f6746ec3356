#include "operations.h"

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

/* The index of the last coordinate that is not greater than x; 0 if there is none. */
static size_t place_of(double x, const double *coordinates, size_t count) {
    size_t low = 0, high = count;

    while (high - low > 1) {
        const size_t middle = low + (high - low) / 2;
        if (coordinates[middle] <= x) {
            low = middle;
        } else {
            high = middle;
        }
    }
    return low;
}

/* The arithmetic of numpy.interp. */
static double between(double x, const double *xs, const double *ys, size_t place) {
    const double slope = (ys[place + 1] - ys[place]) / (xs[place + 1] - xs[place]);
    double y = slope * (x - xs[place]) + ys[place];

    if (isnan(y)) {
        y = slope * (x - xs[place + 1]) + ys[place + 1];
        if (isnan(y) && ys[place] == ys[place + 1]) {
            y = ys[place];
        }
    }
    return y;
}

static double interpolated(double x, const double *table, size_t count) {
    const double *xs = table, *ys = table + count;

    if (isnan(x)) {
        return x;
    }
    if (x < xs[0]) {
        return ys[count];
    }
    if (x > xs[count - 1]) {
        return ys[count + 1];
    }
    const size_t place = place_of(x, xs, count);
    return place == count - 1 || xs[place] == x ? ys[place] : between(x, xs, ys, place);
}

void operation_interpolate(const Table *table, const double *from, size_t count, double *to) {
    const double *values = (const double *)(const void *)table->data;

    for (size_t j = 0; j < count; j++) {
        to[j] = interpolated(from[j], values, table->length / 2 - 1);
    }
}
