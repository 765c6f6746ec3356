/* FMUs that fail and say why only if they are asked to: the token says how, as words in any order.

   "refuse", "initialize", "set", "step", "discard", "get": the call that fails.
   "mute": it logs nothing, whatever it is asked. "loud": it logs without being asked.
   "chatty": it takes no notice of the categories, and logs each step when it is asked for any.
   "no categories": it fails when it is asked for categories, and all later calls fail. "strict": it knows no category.
   "prints", "unflushed": lines on its standard output before it fails, the last without an end.
   "crash", "hang": how the step fails. "control": the messages have control characters.
   "long": ten lines, and the cause is in the last but one.
   Reals: 0 "u" (input), 1 "y" (output), 2 "at" (parameter: the step that fails; 0 for none),
   3 "asked" (output: how often it was asked). */

#include "zoo.h"

#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { U, Y, AT, ASKED, VALUES };

struct Animal {
    double values[VALUES];
    int steps;
    bool all, errors, wrecked;
    Logger logger;
    void *environment;
    char name[200], token[100];
};

static bool is(const Animal *me, const char *word) {
    return strstr(me->token, word) != NULL;
}

static void say(const Animal *me, int status, const char *category, const char *text) {
#if FMI_VERSION == 3
    me->logger(me->environment, status, category, text);
#else
    me->logger(me->environment, me->name, status, category, "%s", text);
#endif
}

static void say_ten_lines(const Animal *me) {
    char line[60];
    for (int i = 1; i <= 8; i++) {
        snprintf(line, sizeof line, "timestep %d of the day is done", i);
        say(me, OK, "logAll", line);
    }
    say(me, OK, "logAll", "** Severe ** the node has no flow");
    say(me, OK, "logAll", "the run time was 0 h 0 min");
}

static int fail(const Animal *me, int status, const char *call) {
    char text[200];

    snprintf(text, sizeof text, "%s because of %s%s", "Exception: the valve is stuck", call,
             is(me, "control") ? " \x1b[31m\x07" : "");
    if (is(me, "prints")) {
        printf("the solver gives up\nCPU time: 3 s\n");
        fprintf(stderr, "the oil is cold\n");
    }
    if (is(me, "unflushed")) {
        printf("no end");
    }
    if (!is(me, "mute") && (me->all || me->errors || is(me, "loud"))) {
        if (is(me, "long")) {
            say_ten_lines(me);
        } else {
            say(me, status, status == DISCARD ? "logStatusDiscard" : "logStatusError", text);
        }
    }
    return status;
}

static int call(const Animal *me, const char *name) {
    return me->wrecked || is(me, name) ? fail(me, ERROR, name) : OK;
}

Animal *zoo_instantiate(const Birth *birth) {
    Animal *me = calloc(1, sizeof *me);

    snprintf(me->name, sizeof me->name, "%s", birth->name);
    snprintf(me->token, sizeof me->token, "%s", birth->token);
    me->logger = birth->logger;
    me->environment = birth->environment;
    me->all = birth->logging;
    if (call(me, "refuse") != OK) {
        free(me);
        return NULL;
    }
    return me;
}

void zoo_free(Animal *me) {
    free(me);
}

int zoo_exit(Animal *me) {
    return call(me, "initialize");
}

int zoo_listen(Animal *me, bool on, size_t count, const char *const *categories) {
    me->values[ASKED]++;
    me->errors = false;
    if (is(me, "chatty")) {
        me->all = on;
    } else {
        me->all = on && count == 0;
        for (size_t i = 0; i < count; i++) {
            me->errors |= on && strcmp(categories[i], "logStatusError") == 0;
        }
    }
    me->wrecked = is(me, "no categories");
    return is(me, "no categories") || (is(me, "strict") && count > 0) ? ERROR : OK;
}

int zoo_reset(Animal *me) {
    memset(me->values, 0, sizeof(double) * ASKED);
    me->steps = 0;
    return OK;
}

int zoo_step(Animal *me, double step_size, bool no_set_state) {
    me->steps++;
    if (me->all && !is(me, "mute")) {
        say(me, OK, "logAll", "a step");
    }
    if (me->steps == (int)me->values[AT]) {
        if (is(me, "crash") || is(me, "hang")) {
            fail(me, ERROR, "step");
            fflush(stderr);
            raise(is(me, "hang") ? SIGSTOP : SIGSEGV);
        }
        if (is(me, "discard")) {
            return fail(me, DISCARD, "discard");
        }
        return call(me, "step");
    }
    me->values[Y] += step_size * me->values[U];
    return me->wrecked ? ERROR : OK;
}

int zoo_set(Animal *me, const unsigned *references, size_t count, const double *values) {
    for (size_t i = 0; i < count; i++) {
        me->values[references[i]] = values[i];
        if (references[i] == U && me->steps + 1 == (int)me->values[AT]) {
            return call(me, "set");
        }
    }
    return OK;
}

int zoo_get(Animal *me, const unsigned *references, size_t count, double *values) {
    zoo_read(me->values, references, count, values);
    return me->steps > 0 && me->steps == (int)me->values[AT] ? call(me, "get") : OK;
}
