/* All sources of an FMU in one translation unit, so that the compiler can inline across them. */

#include "model.c"

#include "log.c"
#include "instance.c"
#include "solvers.c"
#include "simulation.c"
#include "state.c"
#include "values.c"

#if FMI_VERSION == 1
#include "fmi1.c"
#elif FMI_VERSION == 2
#include "fmi2.c"
#else
#include "fmi3.c"
#endif
