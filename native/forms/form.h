/* Forms: what opens a pool, programs, and what requests and answers consist of, as bytes.
 *
 * A form is a row of numbers of 8 bytes: integers, flags and doubles. A block has its size before it,
 * and zeros after it up to the next multiple of 8. A text is a block that ends with a zero. So every
 * number lies at an address that is a multiple of its size, and nothing has to be copied out of a
 * form. fmugym/pool/pool_form.py writes forms.
 *
 * Anyone may have written the bytes: what does not fit is refused. */

#ifndef FMUGYM_FORM_H
#define FMUGYM_FORM_H

#include "fmi/access.h"

enum { FORM_VERSION = 1 }; /* fmugym/pool/pool_form.py has the same number */

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
/* The table of functions for an FMI version and a kind of interface (manner_of in Python). NULL with a
 * fault if there is none. */
const Fmi *read_fmi(Reader *reader);
/* A list of variables, which the caller closes. Returns whether there is no fault. */
bool read_access(Reader *reader, const Fmi *fmi, Access *access);

/* For readers of forms: */

extern const char form_truncated[], form_no_memory[]; /* faults */

/* Notes the fault unless the condition holds. Returns whether there is no fault at all. */
bool reader_require(Reader *reader, bool holds, const char *fault);
/* Memory for so many items, and for one at least, which the caller frees; NULL with a fault if memory
 * runs out. */
void *reader_room(Reader *reader, size_t count, size_t size);
/* How many items follow, each of which takes at least 8 bytes. */
size_t read_count(Reader *reader);
/* An array with so many values; NULL with the fault if there are more or fewer. */
const void *read_values(Reader *reader, size_t size, size_t wanted, const char *fault);
/* A copy of a form at an address that is aligned, which the caller frees, or NULL. */
char *form_copy(const void *form, size_t size);

#endif
