/* A shared library and the functions found in it. */

#ifndef FMUGYM_LIBRARY_H
#define FMUGYM_LIBRARY_H

#include <stdbool.h>
#include <stddef.h>

typedef void (*Function)(void);

typedef struct {
    void *handle;
    const char *identifier; /* the prefix of FMI 1.0 */
    void *functions;        /* the table of the FMI version */
} Library;

/* Loads a library at a path, or one that the loader knows by its name. Returns its handle, or NULL;
 * then error says why. */
void *library_load(const char *path, char *error, size_t size);

/* Returns whether the library was loaded; if not, error says why. */
bool library_open(Library *library, const char *path, char *error, size_t size);
void library_close(Library *library);

/* Copies the file of a library, and removes a copy. Returns whether it was copied. */
bool library_copy(const char *from, const char *to);
void library_remove(const char *path);

/* A function of the library and its place in the table of functions. */
typedef struct {
    const char *name; /* without the prefix */
    size_t offset;
    bool required;
} Binding;

/* Fills the table of functions. Functions that the library does not export are NULL. Returns
 * false if a required one is missing; error says which. */
bool library_bind(Library *library, const char *prefix, const Binding *bindings, size_t count,
                  size_t table_size, char *error, size_t size);

#endif
