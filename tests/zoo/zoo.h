/* What fmi1.c, fmi2.c and fmi3.c, the interfaces of an FMU for FMI 1.0, 2.0 and 3.0, ask of a model.

   The models: zoo.c and faulty.c do wrong what their parameters say, mortal.c what its token says;
   quirks.c is useful but breaks one promise;
   demanding.c wants a licence or time; words.c says why it fails;
   resource.c and files.c read and write files; limited.c makes some instances only; scratch.c works in data that instances share.
   usual.c does what a model leaves out, and what several do. */

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

/* What an instantiation gets. The location is the folder of the FMU for FMI 1.0, and that of its
   resources for the others; a URI or a path. */
typedef struct {
    const char *name, *token, *location;
    Logger logger;
    void *environment;
    bool logging;
} Birth;

/* Every model has these. Where the token asks for a refusal, zoo_instantiate returns NULL. */
Animal *zoo_instantiate(const Birth *birth);
void zoo_free(Animal *me);
int zoo_step(Animal *me, double step_size, bool no_set_state);
int zoo_get(Animal *me, const unsigned *references, size_t count, double *values);
int zoo_set(Animal *me, const unsigned *references, size_t count, const double *values);
int zoo_reset(Animal *me);

/* usual.c has these for models that leave them out. */
int zoo_call(Animal *me, enum call call); /* does what is asked for in a call: nothing */
int zoo_enter(Animal *me);                /* SETUP and ENTER */
int zoo_exit(Animal *me);
int zoo_initialize(Animal *me);   /* all three */
bool zoo_stops(const Animal *me); /* whether it has asked for the end */
int zoo_listen(Animal *me, bool on, size_t count, const char *const *categories);
int zoo_get_state(Animal *me, void **state);
int zoo_set_state(Animal *me, void *state);
int zoo_free_state(void **state);
int zoo_size_of_bytes(Animal *me, void *state, size_t *size);
int zoo_to_bytes(Animal *me, void *state, char *bytes, size_t size);
int zoo_from_bytes(Animal *me, const char *bytes, size_t size, void **state);

/* For models to call. */
void zoo_read(const double *from, const unsigned *references, size_t count, double *to);
void zoo_write(double *to, const unsigned *references, size_t count, const double *from);
bool zoo_parse_table(void); /* as the weather models of JModelica do it: not safe in threads */

/* What the standard has besides; STUBS is a file with one line each. */
#define STUB(name)                                                                                 \
    int name(void) {                                                                               \
        return ERROR;                                                                              \
    }
