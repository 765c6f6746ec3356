/* As generated code does that was made for one model in a program: it copies the state of an
   instance to global variables, steps, and copies it back. */

static volatile double state, slope;

static void find_slope(double gain, double u) {
    slope = gain * u - state;
}

void integrate_(double *x, const double *gain, const double *u, const int *steps) {
    state = *x;
    for (int i = 0; i < *steps; i++) {
        find_slope(*gain, *u);
        state += 0.001 * slope;
    }
    *x = state;
}
