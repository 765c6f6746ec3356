/* The functions of FMI for model exchange and for clocks, which have one form in all versions. */

#ifndef FMUGYM_EXCHANGE_H
#define FMUGYM_EXCHANGE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* What the FMU tells after one update of its discrete states. */
typedef struct {
    bool again;     /* whether the discrete states need another update */
    bool terminate; /* whether the FMU asks to stop */
    bool has_next;  /* whether it has a time event */
    double next;    /* its time */
} Events;

/* The functions of model exchange that have one form in all FMI versions. */
typedef struct {
    int (*set_time)(void *component, double time);
    int (*set_states)(void *component, const double *x, size_t count);
    int (*get_states)(void *component, double *x, size_t count);
    int (*get_rates)(void *component, double *rates, size_t count);
    int (*get_indicators)(void *component, double *z, size_t count);
    int (*get_nominals)(void *component, double *x, size_t count);
    int (*enter_events)(void *component); /* NULL in FMI 1.0, which has no modes */
    int (*enter_continuous)(void *component);
} Equations;

/* The functions of FMI 3.0 for clocks. */
typedef struct {
    int (*get)(void *instance, const uint32_t *references, size_t count, bool *values);
    int (*set)(void *instance, const uint32_t *references, size_t count, const bool *values);
    int (*get_interval)(void *instance, const uint32_t *references, size_t count,
                        double *intervals, int *qualifiers);
    int (*get_shift)(void *instance, const uint32_t *references, size_t count, double *shifts);
    int (*set_interval)(void *instance, const uint32_t *references, size_t count,
                        const double *intervals);
    int (*get_interval_fraction)(void *instance, const uint32_t *references, size_t count,
                                 uint64_t *counters, uint64_t *resolutions, int *qualifiers);
    int (*get_shift_fraction)(void *instance, const uint32_t *references, size_t count,
                              uint64_t *counters, uint64_t *resolutions);
    int (*set_interval_fraction)(void *instance, const uint32_t *references, size_t count,
                                 const uint64_t *counters, const uint64_t *resolutions);
} ClockFunctions;

#endif
