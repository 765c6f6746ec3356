/* A stand-in for libgfortran 3 and 4, the run-time library of gfortran before GCC 8.
 *
 * It has the functions that numerical libraries call now and then: strings, powers, clocks, and
 * messages on the terminal. fmugym/fmi/fortran_libraries.py adds the other functions that an FMU asks for;
 * they end the process with a message, so that nothing is computed wrongly. Calling conventions:
 * libgfortran's sources of GCC 4 to 7, where the length of a string is an int. */

#define _GNU_SOURCE
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

_Noreturn void fmugym_no_such_function(const char *name) {
    fprintf(stderr, "the stand-in for libgfortran has no function %s, which the FMU calls\n", name);
    abort();
}

_Noreturn static void stop(const char *text, int length) {
    fprintf(stderr, "the Fortran code of the FMU stopped: %.*s\n", length, text);
    abort();
}

/* Strings are padded with blanks. */

static int trimmed(int length, const char *text) {
    while (length > 0 && text[length - 1] == ' ') {
        length--;
    }
    return length;
}

int _gfortran_compare_string(int length1, const char *text1, int length2, const char *text2) {
    const int longest = length1 > length2 ? length1 : length2;

    for (int i = 0; i < longest; i++) {
        const unsigned char a = i < length1 ? (unsigned char)text1[i] : ' ';
        const unsigned char b = i < length2 ? (unsigned char)text2[i] : ' ';
        if (a != b) {
            return a < b ? -1 : 1;
        }
    }
    return 0;
}

void _gfortran_concat_string(int size, char *target, int length1, const char *text1, int length2,
                             const char *text2) {
    for (int i = 0; i < size; i++) {
        const int j = i - length1;
        target[i] = i < length1 ? text1[i] : j < length2 ? text2[j] : ' ';
    }
}

int _gfortran_string_len_trim(int length, const char *text) {
    return trimmed(length, text);
}

void _gfortran_string_trim(int *length, void **target, int size, const char *text) {
    static char empty[1];

    *length = trimmed(size, text);
    *target = *length > 0 ? malloc((size_t)*length) : empty;
    if (*target == NULL) {
        stop("out of memory", 13);
    }
    memcpy(*target, text, (size_t)*length);
}

int _gfortran_string_index(int length, const char *text, int size, const char *part, int back) {
    const int last = length - size;

    if (size == 0) {
        return back ? length + 1 : 1;
    }
    for (int i = 0; i <= last; i++) {
        const int place = back ? last - i : i;
        if (memcmp(text + place, part, (size_t)size) == 0) {
            return place + 1;
        }
    }
    return 0;
}

void _gfortran_adjustl(char *target, int length, const char *text) {
    int blanks = 0;

    while (blanks < length && text[blanks] == ' ') {
        blanks++;
    }
    memmove(target, text + blanks, (size_t)(length - blanks));
    memset(target + length - blanks, ' ', (size_t)blanks);
}

void _gfortran_adjustr(char *target, int length, const char *text) {
    const int kept = trimmed(length, text);

    memmove(target + length - kept, text, (size_t)kept);
    memset(target, ' ', (size_t)(length - kept));
}

/* Powers */

static int64_t integer_power(int64_t base, int64_t exponent) {
    uint64_t result = 1, factor = (uint64_t)base;

    if (exponent < 0) {
        return base == 1 ? 1 : base == -1 ? (exponent % 2 ? -1 : 1) : base == 0 ? 1 / base : 0;
    }
    for (; exponent > 0; exponent /= 2) {
        result *= exponent % 2 ? factor : 1;
        factor *= factor;
    }
    return (int64_t)result;
}

static double real_power(double base, int64_t exponent) {
    uint64_t left = exponent < 0 ? -(uint64_t)exponent : (uint64_t)exponent;
    double result = 1.0, factor = exponent < 0 ? 1.0 / base : base;

    for (; left > 0; left /= 2) {
        result *= left % 2 ? factor : 1.0;
        factor *= factor;
    }
    return result;
}

int32_t _gfortran_pow_i4_i4(int32_t base, int32_t exponent) {
    return (int32_t)integer_power(base, exponent);
}

int32_t _gfortran_pow_i4_i8(int32_t base, int64_t exponent) {
    return (int32_t)integer_power(base, exponent);
}

int64_t _gfortran_pow_i8_i4(int64_t base, int32_t exponent) {
    return integer_power(base, exponent);
}

int64_t _gfortran_pow_i8_i8(int64_t base, int64_t exponent) {
    return integer_power(base, exponent);
}

double _gfortran_pow_r8_i8(double base, int64_t exponent) {
    return real_power(base, exponent);
}

float _gfortran_pow_r4_i8(float base, int64_t exponent) {
    return (float)real_power(base, exponent);
}

/* Clocks */

void _gfortran_cpu_time_4(float *seconds) {
    *seconds = (float)clock() / CLOCKS_PER_SEC;
}

void _gfortran_cpu_time_8(double *seconds) {
    *seconds = (double)clock() / CLOCKS_PER_SEC;
}

/* Writing: to the terminal only, each value after a blank, whatever the format. A write into a
 * string or a file would give wrong values later on, and ends the process. */

enum { INTERNAL_UNIT = 1 << 14, TERMINAL = 6, ERRORS = 0 };

typedef struct {
    int32_t flags;
    int32_t unit;
} Transfer;

void _gfortran_st_write(const Transfer *transfer) {
    const int terminal = transfer->unit == TERMINAL || transfer->unit == ERRORS;

    if ((transfer->flags & INTERNAL_UNIT) || !terminal) {
        fmugym_no_such_function("_gfortran_st_write to a string or a file");
    }
}

void _gfortran_st_write_done(const Transfer *transfer) {
    (void)transfer;
    fputc('\n', stderr);
}

void _gfortran_transfer_character_write(const Transfer *transfer, const char *text, int length) {
    (void)transfer;
    fprintf(stderr, " %.*s", length, text);
}

void _gfortran_transfer_integer_write(const Transfer *transfer, const void *value, int size) {
    int64_t number = 0;

    (void)transfer;
    switch (size) {
    case 1: number = *(const int8_t *)value; break;
    case 2: number = *(const int16_t *)value; break;
    case 4: number = *(const int32_t *)value; break;
    case 8: number = *(const int64_t *)value; break;
    default: break;
    }
    fprintf(stderr, " %lld", (long long)number);
}

void _gfortran_transfer_logical_write(const Transfer *transfer, const void *value, int size) {
    (void)transfer, (void)size;
    fputs(*(const int8_t *)value ? " T" : " F", stderr);
}

void _gfortran_transfer_real_write(const Transfer *transfer, const void *value, int size) {
    (void)transfer;
    fprintf(stderr, " %.17g", size == 4 ? *(const float *)value : *(const double *)value);
}

void _gfortran_transfer_character(const Transfer *transfer, const char *text, int length) {
    _gfortran_transfer_character_write(transfer, text, length);
}

void _gfortran_transfer_integer(const Transfer *transfer, const void *value, int size) {
    _gfortran_transfer_integer_write(transfer, value, size);
}

void _gfortran_transfer_logical(const Transfer *transfer, const void *value, int size) {
    _gfortran_transfer_logical_write(transfer, value, size);
}

void _gfortran_transfer_real(const Transfer *transfer, const void *value, int size) {
    _gfortran_transfer_real_write(transfer, value, size);
}

void _gfortran_flush_i4(const int32_t *unit) {
    (void)unit;
}

/* Start and end */

void _gfortran_set_args(int count, char **arguments) {
    (void)count, (void)arguments;
}

void _gfortran_set_options(int count, int *options) {
    (void)count, (void)options;
}

void _gfortran_stop_string(const char *text, int length) {
    stop(text, text == NULL ? 0 : length);
}

void _gfortran_error_stop_string(const char *text, int length) {
    stop(text, text == NULL ? 0 : length);
}

void _gfortran_stop_numeric(int code) {
    char text[32];
    stop(text, snprintf(text, sizeof text, "STOP %d", code));
}

void _gfortran_stop_numeric_f08(int code) {
    _gfortran_stop_numeric(code);
}

void _gfortran_error_stop_numeric(int code) {
    _gfortran_stop_numeric(code);
}

void _gfortran_exit_i4(const int32_t *code) {
    _gfortran_stop_numeric(code == NULL ? 0 : *code);
}

void _gfortran_os_error(const char *text) {
    stop(text, (int)strlen(text));
}

static void print(const char *format, va_list arguments) {
    vfprintf(stderr, format, arguments);
    fputc('\n', stderr);
}

void _gfortran_runtime_error(const char *format, ...) {
    va_list arguments;

    va_start(arguments, format);
    print(format, arguments);
    va_end(arguments);
    stop("a runtime error", 15);
}

void _gfortran_runtime_error_at(const char *where, const char *format, ...) {
    va_list arguments;

    va_start(arguments, format);
    print(format, arguments);
    va_end(arguments);
    stop(where, (int)strlen(where));
}

void _gfortran_runtime_warning_at(const char *where, const char *format, ...) {
    va_list arguments;

    fprintf(stderr, "%s: ", where);
    va_start(arguments, format);
    print(format, arguments);
    va_end(arguments);
}
