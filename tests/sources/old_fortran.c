/* What an FMU that was linked with libgfortran 4 does with it, when its library is loaded. */

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

int _gfortran_compare_string(int, const char *, int, const char *);
void _gfortran_concat_string(int, char *, int, const char *, int, const char *);
int _gfortran_string_len_trim(int, const char *);
void _gfortran_string_trim(int *, void **, int, const char *);
int _gfortran_string_index(int, const char *, int, const char *, int);
void _gfortran_adjustl(char *, int, const char *);
int32_t _gfortran_pow_i4_i4(int32_t, int32_t);
double _gfortran_pow_r8_i8(double, int64_t);
void _gfortran_st_write(void *);
void _gfortran_transfer_integer_write(void *, void *, int);
void _gfortran_st_write_done(void *);
void _gfortran_matmul_r8(void *, void *, void *);

static void require(int condition) {
    if (!condition) {
        abort();
    }
}

__attribute__((constructor)) static void use(void) {
    char text[6], *trimmed = NULL;
    int length = 0, number = -42;
    struct {
        int32_t flags, unit;
        char rest[600];
    } transfer = {0, 6, ""};

    require(_gfortran_compare_string(3, "abc", 5, "abc  ") == 0);
    require(_gfortran_compare_string(3, "abc", 3, "abd") < 0);
    require(_gfortran_compare_string(4, "abc~", 3, "abc") > 0);
    _gfortran_concat_string(6, text, 2, "ab", 3, "cde");
    require(memcmp(text, "abcde ", 6) == 0);
    _gfortran_concat_string(3, text, 2, "ab", 3, "cde");
    require(memcmp(text, "abcde ", 6) == 0);
    require(_gfortran_string_len_trim(6, text) == 5);
    _gfortran_string_trim(&length, (void **)&trimmed, 6, text);
    require(length == 5 && memcmp(trimmed, "abcde", 5) == 0);
    free(trimmed);
    require(_gfortran_string_index(6, "ababab", 2, "ab", 0) == 1);
    require(_gfortran_string_index(6, "ababab", 2, "ab", 1) == 5);
    require(_gfortran_string_index(2, "ab", 3, "abc", 0) == 0);
    _gfortran_adjustl(text, 4, "  ab");
    require(memcmp(text, "ab  ", 4) == 0);
    require(_gfortran_pow_i4_i4(-3, 5) == -243 && _gfortran_pow_i4_i4(2, -1) == 0);
    require(_gfortran_pow_r8_i8(2.0, -2) == 0.25);
    _gfortran_st_write(&transfer);
    _gfortran_transfer_integer_write(&transfer, &number, 4);
    _gfortran_st_write_done(&transfer);
    if (getenv("CALL_MATMUL") != NULL) {
        _gfortran_matmul_r8(NULL, NULL, NULL);
    }
}
