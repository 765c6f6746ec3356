/* The forms of programs, and of the draws of an episode. fmugym/pool/pool_form.py writes them. */

#ifndef FMUGYM_PROGRAM_FORM_H
#define FMUGYM_PROGRAM_FORM_H

#include "forms/form.h"
#include "program/draws.h"
#include "program/program.h"

/* The draws of an episode, without the functions of numpy. Returns whether there is no fault. */
bool read_draws(Reader *reader, Draws *draws);

/* A program, and the memory that belongs to it. */
typedef struct {
    Program program;
    char *form; /* a copy of it, which the program points to */
    Row *rows;
    Table *tables;
    char *filled; /* the memory of the constants' registers */
} ProgramForm;

/* Reads the form of a program that so many rows come with. Returns what is wrong with it, or NULL. The
 * caller must drop it in any case; settle it before it runs. */
const char *program_take(ProgramForm *p, const void *form, size_t size, size_t number_of_rows);
/* Takes the rows that come with the program. Returns what is wrong, or NULL. */
const char *program_settle(ProgramForm *p, const Row *rows);
void program_drop(ProgramForm *p);

#endif
