/* What goes in comes out, in every type of FMI 1.0, 2.0 and 3.0.

   The value references: ten times the number of the type, and 0 for an input, 1 for the output with
   its value, 2 for a parameter, 3 for the output with this one's value; 4 and 5 are more inputs, with
   the outputs 6 and 7. 301 is a real output, the length of the String parameter. FMI 3.0 has a matrix of Int16, 204, with the output 205. Reference
   4 of Int64, or of Integer, is an enumeration, which begins with 1. */

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { OK, WARNING, DISCARD, ERROR };
enum { INPUT, OUTPUT, PARAMETER, TOLD, MORE, PLACES = 8, MATRIX = 4, LONGEST = 200, LENGTH = 301 };

#if FMI_VERSION == 3
#define PREFIX(name) fmi3##name
#define SIZE , size_t size
#define TYPES(F)                                                                                   \
    F(Float64, double) F(Float32, float) F(Int8, int8_t) F(UInt8, uint8_t) F(Int16, int16_t)       \
    F(UInt16, uint16_t) F(Int32, int32_t) F(UInt32, uint32_t) F(Int64, int64_t)                    \
    F(UInt64, uint64_t) F(Boolean, bool)
#elif FMI_VERSION == 2
#define PREFIX(name) fmi2##name
#define SIZE
#define TYPES(F) F(Real, double) F(Integer, int) F(Boolean, int)
#else
#define PREFIX(name) Model_fmi##name
#define SIZE
#define TYPES(F) F(Real, double) F(Integer, int) F(Boolean, char)
#endif

#define NAME(name, type) TYPE_##name,
enum { TYPES(NAME) STRINGS };

typedef struct {
#define MEMBER(name, type) type name[PLACES];
    TYPES(MEMBER)
    int16_t matrix[MATRIX];
    char texts[PLACES][LONGEST];
    double length; /* of the String parameter */
} Model;

/* The value of an output is that of its input or parameter. */
static unsigned source_of(unsigned place) {
    return place == OUTPUT ? INPUT : place == TOLD ? PARAMETER : place > 5 ? place - 2 : place;
}

/* The values of a variable, and their size in bytes. */
static char *find(Model *me, unsigned reference, size_t *size) {
    if (reference == LENGTH) {
        return *size = sizeof me->length, (char *)&me->length;
    }
    switch (reference >= 200 ? STRINGS : reference / 10) {
#define FIND(name, type)                                                                           \
    case TYPE_##name: return *size = sizeof(type), (char *)&me->name[source_of(reference % 10)];
        TYPES(FIND)
    default: return *size = sizeof me->matrix, (char *)me->matrix;
    }
}

static int get(Model *me, const unsigned *references, size_t count, char *values) {
    for (size_t i = 0, size; i < count; i++, values += size) {
        const char *own = find(me, references[i], &size);
        memcpy(values, own, size);
    }
    return OK;
}

static int set(Model *me, const unsigned *references, size_t count, const char *values) {
    for (size_t i = 0, size; i < count; i++, values += size) {
        char *own = find(me, references[i], &size);
        memcpy(own, values, size);
    }
    return OK;
}

#define ACCESS(name, type)                                                                         \
    int PREFIX(Get##name)(Model *me, const unsigned *references, size_t count, char *values SIZE) {\
        return get(me, references, count, values);                                                 \
    }                                                                                              \
    int PREFIX(Set##name)(Model *me, const unsigned *references, size_t count,                     \
                          const char *values SIZE) {                                               \
        return set(me, references, count, values);                                                 \
    }
TYPES(ACCESS)

int PREFIX(GetString)(Model *me, const unsigned *references, size_t count, const char **values
                      SIZE) {
    for (size_t i = 0; i < count; i++) {
        values[i] = me->texts[source_of(references[i] - 10 * STRINGS)];
    }
    return OK;
}

int PREFIX(SetString)(Model *me, const unsigned *references, size_t count,
                      const char *const *values SIZE) {
    for (size_t i = 0; i < count; i++) {
        snprintf(me->texts[references[i] - 10 * STRINGS], LONGEST, "%s", values[i]);
    }
    me->length = (double)strlen(me->texts[PARAMETER]);
    return OK;
}

#if FMI_VERSION == 3
#define GEAR Int64
#else
#define GEAR Integer
#endif

static int to_start(Model *me) {
    memset(me, 0, sizeof *me);
    me->GEAR[MORE] = 1;
    strcpy(me->texts[PARAMETER], "start");
    return OK;
}

static void *make(void) {
    Model *me = malloc(sizeof *me);
    to_start(me);
    return me;
}

#if FMI_VERSION > 1
static int copy_state(const Model *me, void **state) {
    *state = *state == NULL ? malloc(sizeof *me) : *state;
    memcpy(*state, me, sizeof *me);
    return OK;
}
#endif

#if FMI_VERSION == 3

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                  bool visible, bool logging, bool event_mode, bool early_return,
                                  const unsigned *intermediate, size_t intermediate_count,
                                  void *environment, void *logger, void *intermediate_update) {
    return make();
}

void fmi3FreeInstance(Model *me) {
    free(me);
}

int fmi3EnterInitializationMode(Model *me, bool has_tolerance, double tolerance, double start,
                                bool has_stop, double stop) {
    return OK;
}

int fmi3ExitInitializationMode(Model *me) {
    return OK;
}

int fmi3Terminate(Model *me) {
    return OK;
}

int fmi3Reset(Model *me) {
    return to_start(me);
}

int fmi3DoStep(Model *me, double time, double step, bool no_set_state, bool *event,
               bool *terminate, bool *early, double *last) {
    *event = *terminate = *early = false;
    *last = time + step;
    return OK;
}

int fmi3GetFMUState(Model *me, void **state) {
    return copy_state(me, state);
}

int fmi3SetFMUState(Model *me, const void *state) {
    memcpy(me, state, sizeof *me);
    return OK;
}

int fmi3FreeFMUState(Model *me, void **state) {
    free(*state);
    *state = NULL;
    return OK;
}

const char *fmi3GetVersion(void) {
    return "3.0";
}

#elif FMI_VERSION == 2

void *fmi2Instantiate(const char *name, int kind, const char *token, const char *resources,
                      const void *functions, int visible, int logging) {
    return make();
}

void fmi2FreeInstance(Model *me) {
    free(me);
}

int fmi2SetupExperiment(Model *me, int has_tolerance, double tolerance, double start, int has_stop,
                        double stop) {
    return OK;
}

int fmi2EnterInitializationMode(Model *me) {
    return OK;
}

int fmi2ExitInitializationMode(Model *me) {
    return OK;
}

int fmi2Terminate(Model *me) {
    return OK;
}

int fmi2Reset(Model *me) {
    return to_start(me);
}

int fmi2DoStep(Model *me, double time, double step, int no_set_state) {
    return OK;
}

int fmi2GetFMUstate(Model *me, void **state) {
    return copy_state(me, state);
}

int fmi2SetFMUstate(Model *me, const void *state) {
    memcpy(me, state, sizeof *me);
    return OK;
}

int fmi2FreeFMUstate(Model *me, void **state) {
    free(*state);
    *state = NULL;
    return OK;
}

const char *fmi2GetVersion(void) {
    return "2.0";
}

const char *fmi2GetTypesPlatform(void) {
    return "default";
}

#else

void *Model_fmiInstantiateSlave(const char *name, const char *token, const char *location,
                                const char *mime, double timeout, char visible, char interactive,
                                const void *functions, char logging) {
    return make();
}

void Model_fmiFreeSlaveInstance(Model *me) {
    free(me);
}

int Model_fmiInitializeSlave(Model *me, double start, char has_stop, double stop) {
    return OK;
}

int Model_fmiTerminateSlave(Model *me) {
    return OK;
}

int Model_fmiResetSlave(Model *me) {
    return to_start(me);
}

int Model_fmiDoStep(Model *me, double time, double step, char new_step) {
    return OK;
}

const char *Model_fmiGetVersion(void) {
    return "1.0";
}

const char *Model_fmiGetTypesPlatform(void) {
    return "standard32";
}

#endif

#define STUB(name)                                                                                 \
    int name(void) {                                                                               \
        return ERROR;                                                                              \
    }
#include STUBS
