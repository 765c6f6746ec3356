/* Entering pools, and reporting the messages of their FMUs. */

#include <string.h>

#include "pool/inside.h"
#include "python/python.h"

/* The package is not imported before: workers do without it. */
static void raise_closed(void) {
    PyObject *module = PyImport_ImportModule("fmugym.errors");
    PyObject *type = module == NULL ? NULL : PyObject_GetAttrString(module, "SimulationError");

    if (type != NULL) {
        PyErr_SetString(type, "the pool is closed");
    }
    Py_XDECREF(type);
    Py_XDECREF(module);
}

bool require_arguments(Py_ssize_t given, Py_ssize_t expected) {
    if (given != expected) {
        PyErr_Format(PyExc_TypeError, "expected %zd arguments, got %zd", expected, given);
    }
    return given == expected;
}

PyObject *decode(const char *text) {
    return PyUnicode_DecodeUTF8(text == NULL ? "" : text,
                                text == NULL ? 0 : (Py_ssize_t)strlen(text), "replace");
}

/* Messages go to Python after a call, on the thread that made the call. */

/* The caller gets what the receiver raises: it may come from a signal handler that ran in it. */
static bool report(PyPool *self, const Message *message) {
    PyObject *result =
        PyObject_CallFunction(self->callback, "niNN", (Py_ssize_t)message->index, message->status,
                              decode(message->category), decode(message->text));

    Py_XDECREF(result);
    return result != NULL;
}

static bool report_dropped(PyPool *self) {
    static char category[] = "fmugym", text[] = "later messages were dropped: too many at once";
    const Message message = {.status = STATUS_WARNING, .category = category, .text = text};
    return report(self, &message);
}

/* If an exception interrupts this, the next call reports the remaining messages. */
static bool drain(PyPool *self) {
    size_t dropped;
    Message *left = log_take(&self->pool.log, &dropped);
    bool good = true;

    while (good && left != NULL) {
        Message *message = left;
        left = message->next;
        good = report(self, message);
        message_free(message);
    }
    if (good && dropped > 0) {
        dropped = 0;
        good = report_dropped(self);
    }
    if (left != NULL || dropped > 0) {
        log_give_back(&self->pool.log, left, dropped);
    }
    return good;
}

bool report_messages(PyPool *self) {
    return !atomic_get(&self->pool.log.pending) || drain(self);
}

/* Entering */

/* Getting the GIL back may take milliseconds if other Python threads are busy. So very short
 * work keeps the GIL. */
static bool is_short(const PyPool *self, int operation) {
    return operation != NO_OPERATION && pool_is_quick(&self->pool, operation);
}

bool explain_entry(Entry entry) {
    if (entry == ENTRY_CLOSED) {
        raise_closed();
    } else if (entry == ENTRY_INSIDE) {
        PyErr_SetString(PyExc_RuntimeError, "an FMU has called the pool that it is in");
    }
    return entry == ENTRY_ENTERED;
}

/* Signals that come while a pool works. */
typedef struct {
    PyThreadState *released; /* NULL if the thread has the GIL */
    PyObject *type, *value, *traceback; /* what a handler has raised */
} Signals;

/* Lets the handlers of signals run. Work ends early if one of them raises an exception, which waits
 * until the pool is left. */
static bool handle_signals(void *context) {
    Signals *me = context;
    const bool released = me->released != NULL;

    if (released) {
        PyEval_RestoreThread(me->released);
    }
    const bool raised = PyErr_CheckSignals() < 0;
    if (raised) {
        PyErr_Fetch(&me->type, &me->value, &me->traceback);
    }
    if (released) {
        me->released = PyEval_SaveThread();
    }
    return raised;
}

static void work_and_leave(PyPool *self, Work *work, void *context, Signals *signals) {
    const Caller before = inside_of_caller((Caller){handle_signals, signals});

    work(self, signals->released == NULL, context);
    inside_of_caller(before);
    pool_leave(&self->pool);
}

bool perform(PyPool *self, int operation, Work *work, void *context) {
    Entry entry = pool_try_enter(&self->pool);
    Signals signals = {0};

    if (entry == ENTRY_ENTERED && is_short(self, operation)) {
        work_and_leave(self, work, context, &signals);
    } else if (entry == ENTRY_ENTERED || entry == ENTRY_BUSY) {
        signals.released = PyEval_SaveThread();
        entry = entry == ENTRY_BUSY ? pool_enter(&self->pool) : entry;
        if (entry == ENTRY_ENTERED) {
            work_and_leave(self, work, context, &signals);
        }
        PyEval_RestoreThread(signals.released);
    }
    if (signals.type != NULL) {
        PyErr_Restore(signals.type, signals.value, signals.traceback);
        return false;
    }
    return explain_entry(entry);
}
