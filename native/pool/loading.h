/* Loads the library of an FMU, or those of a system. */

#ifndef FMUGYM_LOADING_H
#define FMUGYM_LOADING_H

#include "pool/pool.h"

/* How many FMUs an instance has. */
size_t parts_of(const Settings *settings);

/* Loads the library of this index among those of the pool. Returns whether that worked; if not,
 * error says why, and the caller must still unload it. */
bool pool_load(Pool *pool, size_t index, char *error, size_t size);
void pool_unload(Pool *pool, size_t index);
/* The same for any library of the pool's FMU, from other files. */
bool pool_load_from(Pool *pool, Library *library, const char *const *paths, char *error,
                    size_t size);
void pool_unload_from(Pool *pool, Library *library);

#endif
