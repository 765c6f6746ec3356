/* Messages of solvers, and their interruption. */

#include "model_exchange/solver.h"

#include <stdarg.h>
#include <stdio.h>

#include "fmi/log.h"
#include "model_exchange/interruption.h"

enum { FEW = 15, SHORT_STEP = 1000000 /* ns */ };

static void say(const Solver *me, Status status, const char *format, va_list values) {
    char text[300];

    vsnprintf(text, sizeof text, format, values);
    log_message_fmi3((void *)(uintptr_t)me->environment, (int)status, "solver", text);
}

Status solver_fail(const Solver *me, const char *format, ...) {
    va_list values;

    va_start(values, format);
    say(me, STATUS_ERROR, format, values);
    va_end(values);
    return STATUS_ERROR;
}

void solver_warn(const Solver *me, const char *format, ...) {
    va_list values;

    va_start(values, format);
    say(me, STATUS_WARNING, format, values);
    va_end(values);
}

/* Reading the clock takes as long as a light model, so this does not happen in each of its steps. */
bool solver_is_interrupted(Solver *me) {
    if (me->unseen > 0) {
        me->unseen--;
        return false;
    }
    const uint64_t now = clock_now();
    me->unseen = now - me->looked < SHORT_STEP ? FEW : 0;
    me->looked = now;
    return is_interrupted();
}
