/* The state machine, initialization and the communication step. */

#ifndef SIMULATION_H
#define SIMULATION_H

#include "types.h"

/* Refuses a call unless the present phase is one of the allowed ones. */
Status check_phase(const Instance *instance, const char *function, int32_t allowed);

Status set_up_experiment(Instance *instance, const char *function, double start_time,
                         bool stop_time_defined, double stop_time);
Status enter_initialization(Instance *instance, const char *function);
Status exit_initialization(Instance *instance, const char *function);
Status do_step(Instance *instance, const char *function, double time, double step);
Status terminate(Instance *instance, const char *function);

/* Updates the variables that are calculated on demand. */
Status refresh(Instance *instance, const char *function);

#endif
