/* The texts of Strings that FMUs have given. Values are doubles on their way, so a number stands for
 * each text: the same as in fmugym/archive/texts.py. */

#ifndef FMUGYM_TEXTS_H
#define FMUGYM_TEXTS_H

/* A text, and the number that stands for it; see fmugym/archive/texts.py. */
typedef struct {
    double number;
    const char *text;
} Text;

/* Keeps a text of this process for good, and returns its number; -1 if there is no memory, if there
 * are too many texts, or if another text has this number. NULL counts as empty. */
double text_number(const char *text);

/* The text with this number, or NULL if text_number has not returned it. */
const char *text_with(double number);

/* Fork. The lock is held during a fork, so that the child finds no unfinished change. */
void texts_before_fork(void);
void texts_after_fork_in_parent(void);
void texts_after_fork_in_child(void);

#endif
