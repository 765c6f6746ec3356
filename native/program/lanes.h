/* Loops over the values of a register. */

#ifndef FMUGYM_LANES_H
#define FMUGYM_LANES_H

enum {
    PROGRAM_WIDTH = 128, /* most instances evaluated at the same time */
    PROGRAM_BLOCK = 16  /* operations compute a multiple of this many values */
};

/* Lets compilers that know how do four rounds of the loop that follows at a time. */
#if defined __GNUC__ && !defined __clang__
#define UNROLLED _Pragma("GCC unroll 4")
#else
#define UNROLLED
#endif

/* Computing the end from the blocks shows the compiler that no value is left over. */
#define EACH_LANE(statement)                                                                       \
    UNROLLED                                                                                       \
    for (size_t j = 0; j < blocks * PROGRAM_BLOCK; j++) {                                          \
        statement;                                                                                 \
    }

#endif
