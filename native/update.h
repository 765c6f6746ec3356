/* The intermediate update mode of FMI 3.0: within a step the FMU calls back at times of its own. It then
 * takes inputs that change linearly, and tells outputs of which a step gives a mean, an integral, the least or
 * the greatest value. */

#ifndef FMUGYM_UPDATE_H
#define FMUGYM_UPDATE_H

#include "fmi.h"

struct Solver;
struct Solving;

/* Those of one instance. */
typedef struct Updates Updates;

/* The function that FMUs call. */
void updates_answer(void *environment, double time, bool set_requested, bool get_allowed,
                    bool step_finished, bool can_return_early, bool *early_return_requested,
                    double *early_return_time);

/* The value references that the FMU is told at its instantiation, in new memory; NULL for none. */
uint32_t *updates_references(const struct Solving *solving, size_t *count);

/* For an instance that gets or sets anything in updates. NULL if there is no memory. */
Updates *updates_open(struct Solver *solver);
void updates_close(Updates *me);

/* Lets the FMU step; see Model. */
Status updates_step(struct Solver *solver, double time, double size, double *reached, bool *event,
                    bool *terminate);

/* Begins anew to collect outputs. */
void updates_clear(Updates *me);
/* What a substep gives of its outputs, by the Sampling of each: replaces the values at its end. */
void updates_summarize(void *component, const unsigned char *sampling, double *outputs);
/* The same as updates_clear, for the component of a pool. */
void updates_begin(void *component);

#endif
