/* What solvers ask of the thread that they work on. Whoever lets them work answers: pool/entering.c. */

#ifndef FMUGYM_INTERRUPTION_H
#define FMUGYM_INTERRUPTION_H

#include <stdbool.h>

/* Whether the work of the innermost pool is to end early. Asks the caller of this thread now and then;
 * threads that help have none. */
bool is_interrupted(void);

/* Whether the stiffness of the innermost pool's equations is told for the first time. */
bool is_first_to_find_stiff(void);

#endif
