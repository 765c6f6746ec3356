/* All sources of an FMU as one, so that the compiler sees through the calls between them. */

#include "model.c"

#include "instance.c"
#include "simulation.c"
#include "solvers.c"
#include "state.c"
#include "values.c"

#if FMI_VERSION == 1
#include "fmi1.c"
#elif FMI_VERSION == 2
#include "fmi2.c"
#else
#include "fmi3.c"
#endif
