/* The first step fills a table, and says that it is there before it is complete. */

enum { ROWS = 2000 };

static volatile double table[ROWS];
static volatile int rows;

static void fill_table(void) {
    while (rows < ROWS) {
        const int row = rows;

        table[row] = 0.001;
        rows = row + 1;
    }
}

void integrate_(double *x, const double *gain, const double *u, const int *steps) {
    if (rows == 0) {
        fill_table();
    }
    for (int i = 0; i < *steps; i++) {
        *x += table[ROWS - 1 - i] * (*gain * *u - *x);
    }
}
