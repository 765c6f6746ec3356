/* The form of a pool: its settings, and the FMU or the system. fmugym/pool/pool_form.py writes it. */

#ifndef FMUGYM_POOL_FORM_H
#define FMUGYM_POOL_FORM_H

#include "forms/form.h"
#include "pool/pool.h"
#include "system/system.h"

/* What opens a pool. */
typedef struct {
    char *form; /* a copy of it, which the settings point to */
    Settings settings; /* without the arrays of the pool */
    Access inputs, outputs;
    System *system; /* NULL for one FMU */
} Opening;

/* Reads the form of a pool. Returns what is wrong with it, or NULL. The caller must drop the opening
 * in any case, and must not move it as long as the pool exists. */
const char *opening_take(Opening *opening, const void *form, size_t size);
void opening_drop(Opening *opening);

#endif
