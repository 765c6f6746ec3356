/* What fmi1.c, fmi2.c and fmi3.c, the interfaces of an FMU for FMI 1.0, 2.0 and 3.0, ask of a model.

   There are two models: zoo.c does wrong what its parameters say, quirks.c is useful but breaks one
   promise. */

#include <stdbool.h>
#include <stddef.h>

enum call {
    NOWHERE,
    INSTANTIATE,
    SETUP,
    ENTER,
    EXIT,
    SET,
    STEP,
    GET,
    RESET,
    GET_STATE,
    SET_STATE,
    TERMINATE,
    FREE
};

enum status { OK, WARNING, DISCARD, ERROR };

#if FMI_VERSION == 3
typedef void (*Logger)(void *environment, int status, const char *category, const char *message);
#else
typedef void (*Logger)(void *environment, const char *name, int status, const char *category,
                       const char *format, ...);
#endif

typedef struct Animal Animal;

/* NULL where the token asks for a refusal. The location is the folder of the FMU for FMI 1.0, and
   that of its resources for the others; a URI or a path. */
Animal *zoo_instantiate(const char *name, const char *token, const char *location, Logger logger,
                        void *environment);
void zoo_free(Animal *me);

/* Do what is asked for in a call, and return its status. */
int zoo_call(Animal *me, enum call call);
int zoo_enter(Animal *me); /* SETUP and ENTER */
int zoo_exit(Animal *me);
int zoo_initialize(Animal *me); /* all three */
int zoo_step(Animal *me, double step_size, bool no_set_state);
bool zoo_stops(const Animal *me); /* whether it has asked for the end */
int zoo_get(Animal *me, const unsigned *references, size_t count, double *values);
int zoo_set(Animal *me, const unsigned *references, size_t count, const double *values);
int zoo_reset(Animal *me);
int zoo_get_state(Animal *me, void **state);
int zoo_set_state(Animal *me, void *state);
int zoo_free_state(void **state);

/* What the standard has besides; STUBS is a file with one line each. */
#define STUB(name)                                                                                 \
    int name(void) {                                                                               \
        return ERROR;                                                                              \
    }
