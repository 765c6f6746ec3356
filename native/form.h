/* Forms: what opens a pool, and what requests and answers consist of, as bytes.
 *
 * A form is a row of numbers of 8 bytes: integers, flags and doubles. A block has its size before it,
 * and zeros after it up to the next multiple of 8. A text is a block that ends with a zero. So every
 * number lies at an address that is a multiple of its size, and nothing has to be copied out of a
 * form. fmugym/pool/form.py writes forms.
 *
 * Anyone may have written the bytes: what does not fit is refused. */

#ifndef FMUGYM_FORM_H
#define FMUGYM_FORM_H

#include "pool.h"
#include "system.h"

enum { FORM_VERSION = 1 }; /* fmugym/pool/form.py has the same number */

/* Reads a form from memory that is aligned to 8 bytes. What is missing reads as 0, and after that
 * nothing can be read any more. */
typedef struct {
    const char *at, *end;
    const char *fault; /* what is wrong, or NULL */
} Reader;

/* Notes what is wrong, unless something was before. Returns false. */
bool reader_refuse(Reader *reader, const char *fault);

int64_t read_integer(Reader *reader);
/* An integer from lowest to highest. */
int64_t read_integer_in(Reader *reader, int64_t lowest, int64_t highest);
bool read_flag(Reader *reader);
double read_number(Reader *reader);
/* Bytes; the values of an array of this size, and how many; a text. They live as long as the form. */
Block read_block(Reader *reader);
const void *read_array(Reader *reader, size_t size, size_t *count);
const char *read_text(Reader *reader);
/* Texts; the caller frees the array. Returns NULL if there is a fault. */
const char **read_texts(Reader *reader, size_t *count);
/* The version and manner of an FMU, or NULL with a fault if there is none. */
const Fmi *read_fmi(Reader *reader);
/* A list of variables, which the caller closes. Returns whether there is no fault. */
bool read_access(Reader *reader, const Fmi *fmi, Access *access);
/* The draws of an episode, without the functions of numpy. Returns whether there is no fault. */
bool read_draws(Reader *reader, Draws *draws);

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

/* A program, and the memory that belongs to it. */
typedef struct {
    Program program;
    char *form; /* a copy of it, which the program points to */
    Row *rows;
    Table *tables;
    char *filled; /* the memory of the constants' registers */
    size_t seen_sizes[MOST_SEEN]; /* of each array of observations, for one instance */
} ProgramForm;

/* Reads the form of a program that so many rows come with. Returns what is wrong with it, or NULL. The
 * caller must drop it in any case; settle it before it runs. */
const char *program_take(ProgramForm *p, const void *form, size_t size, size_t number_of_rows);
/* Takes the rows that come with the program. Returns what is wrong, or NULL. */
const char *program_settle(ProgramForm *p, const Row *rows, size_t action_elements);
void program_drop(ProgramForm *p);

#endif
