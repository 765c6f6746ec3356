#include "solver.h"

#include <stdarg.h>
#include <stdio.h>

#include "log.h"

Status solver_fail(const Solver *me, const char *format, ...) {
    char text[200];
    va_list values;

    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    log_message_fmi3((void *)(uintptr_t)me->environment, STATUS_ERROR, "solver", text);
    return STATUS_ERROR;
}
