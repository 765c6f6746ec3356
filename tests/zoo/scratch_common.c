/* What a Fortran compiler makes of

     subroutine integrate(x, gain, u, steps)
     common /held/ state, slope

   A common block is a tentative definition, which the linker merges with others of that name. */

__attribute__((common)) struct {
    volatile double state, slope;
} held_;

void integrate_(double *x, const double *gain, const double *u, const int *steps) {
    held_.state = *x;
    for (int i = 0; i < *steps; i++) {
        held_.slope = *gain * *u - held_.state;
        held_.state = held_.state + 0.001 * held_.slope;
    }
    *x = held_.state;
}
