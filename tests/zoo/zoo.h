/* FMUs that do wrong what they are told to, for FMI 1.0, 2.0 and 3.0.

   y' = u, read with each step. The parameters say what happens ("fault"), in which call ("call"),
   and after how many steps ("at"); "status" is what STATUS returns. Parameters come too late for
   some faults, which the instantiation token asks for: see zoo.c. */

#include <stdbool.h>
#include <stddef.h>

enum variable { U, Y, FAULT, CALL, AT, STATUS_CODE, VARIABLES };

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

enum fault {
    NONE,
    SEGV,
    FPE,
    ILL,
    BUS,
    ABORT,
    LEAVE,
    OVERFLOW,
    LOOP,
    SLEEP,
    CLOSE_STANDARD,
    CLOSE_OTHERS,
    STATUS,
    NOT_A_NUMBER,
    INFINITE,
    PRINT,
    PRINT_NO_NEWLINE,
    PRINT_MUCH,
    LOG_FROM_THREAD,
    ROUND_UP,
    FLUSH_DENORMALS,
    CHANGE_DIRECTORY,
    CHANGE_ENVIRONMENT,
    LEAK,
    DO_NOTHING,
    FORK,
    FORK_AND_CRASH,
    FORK_AND_LOOP,
    FORK_A_TWIN
};

enum status { OK, WARNING, DISCARD, ERROR };

#if FMI_VERSION == 3
typedef void (*Logger)(void *environment, int status, const char *category, const char *message);
#else
typedef void (*Logger)(void *environment, const char *name, int status, const char *category,
                       const char *format, ...);
#endif

typedef struct Animal Animal;

/* NULL where the token asks for a refusal. */
Animal *zoo_instantiate(const char *name, const char *token, Logger logger, void *environment);
void zoo_free(Animal *me);

/* Do what is asked for in a call, and return its status. */
int zoo_call(Animal *me, enum call call);
int zoo_enter(Animal *me); /* SETUP and ENTER */
int zoo_exit(Animal *me);
int zoo_initialize(Animal *me); /* all three */
int zoo_step(Animal *me, double step_size);
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
