/* What a Fortran compiler makes of

     subroutine integrate(x, gain, u, steps)
     common /work/ state, slope

   A common block is a tentative definition, which the linker merges with others of that name. */

__attribute__((common)) struct {
    volatile double state, slope;
} work_;

void integrate_(double *x, const double *gain, const double *u, const int *steps) {
    work_.state = *x;
    for (int i = 0; i < *steps; i++) {
        work_.slope = *gain * *u - work_.state;
        work_.state = work_.state + 0.001 * work_.slope;
    }
    *x = work_.state;
}
