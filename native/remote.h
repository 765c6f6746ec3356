/* Components of systems in processes of their own: one more table of functions, whose calls go to a
 * worker. A crash there does not end this process.
 *
 * A worker has the same component of several systems. When it ends, their next calls return
 * STATUS_FATAL, and the instances that are made after that get a new worker. Inputs wait until the
 * step takes them along, and the step brings the outputs. */

#ifndef FMUGYM_REMOTE_H
#define FMUGYM_REMOTE_H

#include "fmi.h"

struct Component;

/* How the workers of a component run. */
typedef struct Remote {
    const char **command;     /* ends with NULL, as the following */
    const char **environment;
    const char **preload; /* libraries to be loaded before */
    size_t number_of_preloads;
    const char *path;     /* of the library, as the worker names it; the resources likewise */
    size_t workers;       /* for as many instances as there are in the following */
    size_t instances;
    double call_timeout; /* in seconds; initializations may take ten times as long */
} Remote;

/* The functions for components of an FMI version; NULL where there are none. */
const Fmi *remote_table(int64_t version);

/* Starts the workers. Returns whether that worked; if not, error says why, and the caller must still
 * close the library. */
bool remote_open(Library *library, const struct Component *part, size_t parts, char *error,
                 size_t size);
/* Ends the workers. */
void remote_close(Library *library);

#endif
