/* An FMU of FMI 2.0 with ten zones of a building, for a task of a typical size: 10 inputs (heating
 * power in W), 30 outputs (air and wall temperature in degC and the temperature error of each zone)
 * and few equations. A zone is an air node and a wall node; zones stand in a row:
 *
 *     C_air dT/dt = P + (T_wall - T)/R_wall + (T_left + T_right - 2 T)/R_door
 *     C_wall dT_wall/dt = (T - T_wall)/R_wall + (T_outside - T_wall)/R_facade
 *
 * integrated by explicit Euler in steps of at most a minute. The value references are: inputs 0-9,
 * air 10-19, walls 20-29, errors 30-39, T_outside 40, T_0 41. */

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { ZONES = 10, INPUTS = 0, AIR = 10, WALL = 20, ERROR = 30, OUTSIDE = 40, START = 41, COUNT };

static const double C_AIR = 2e5, C_WALL = 4e6, R_WALL = 0.01, R_DOOR = 0.05, R_FACADE = 0.02;
static const double LONGEST = 60.0, TARGET = 21.0;

typedef struct {
    double values[COUNT];
} Building;

static void measure(Building *me) {
    for (int i = 0; i < ZONES; i++) {
        me->values[ERROR + i] = me->values[AIR + i] - TARGET;
    }
}

static void euler(Building *me, double dt) {
    double *air = me->values + AIR, *wall = me->values + WALL, next[ZONES];

    for (int i = 0; i < ZONES; i++) {
        const double left = air[i > 0 ? i - 1 : i], right = air[i < ZONES - 1 ? i + 1 : i];
        const double to_wall = (air[i] - wall[i]) / R_WALL;
        const double doors = (left + right - 2 * air[i]) / R_DOOR;
        next[i] = air[i] + dt / C_AIR * (me->values[INPUTS + i] - to_wall + doors);
        wall[i] += dt / C_WALL * (to_wall + (me->values[OUTSIDE] - wall[i]) / R_FACADE);
    }
    memcpy(air, next, sizeof next);
}

void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                      const void *callbacks, int visible, int logging) {
    (void)name, (void)type, (void)resources, (void)callbacks, (void)visible, (void)logging;
    return strcmp(token, "{building}") == 0 ? calloc(1, sizeof(Building)) : NULL;
}

void fmi2FreeInstance(Building *me) {
    free(me);
}

int fmi2SetupExperiment(Building *me, int tolerance_defined, double tolerance, double start,
                        int stop_defined, double stop) {
    (void)me, (void)tolerance_defined, (void)tolerance, (void)start, (void)stop_defined, (void)stop;
    return 0;
}

int fmi2EnterInitializationMode(Building *me) {
    (void)me;
    return 0;
}

int fmi2ExitInitializationMode(Building *me) {
    for (int i = 0; i < ZONES; i++) {
        me->values[AIR + i] = me->values[WALL + i] = me->values[START];
    }
    measure(me);
    return 0;
}

int fmi2Reset(Building *me) {
    memset(me, 0, sizeof *me);
    return 0;
}

int fmi2DoStep(Building *me, double time, double step_size, int no_set_state) {
    int count = (int)(step_size / LONGEST);

    (void)time, (void)no_set_state;
    count += count * LONGEST < step_size;
    for (int i = 0; i < count; i++) {
        euler(me, step_size / count);
    }
    measure(me);
    return 0;
}

int fmi2GetReal(Building *me, const unsigned *references, size_t count, double *values) {
    for (size_t i = 0; i < count; i++) {
        values[i] = me->values[references[i]];
    }
    return 0;
}

int fmi2SetReal(Building *me, const unsigned *references, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        me->values[references[i]] = values[i];
    }
    return 0;
}
