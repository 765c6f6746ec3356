/* Entering pools, and reporting the messages of their FMUs. */

#include <string.h>

#include "python.h"

PyObject *sleep_function;

PyObject *find_object(const char *module_name, const char *name) {
    PyObject *module = PyImport_ImportModule(module_name);
    PyObject *found = module == NULL ? NULL : PyObject_GetAttrString(module, name);

    Py_XDECREF(module);
    return found;
}

/* The package is not imported before: workers do without it. */
void raise_simulation_error(const char *format, const char *name) {
    PyObject *type = find_object("fmugym.errors", "SimulationError");

    if (type != NULL) {
        PyErr_Format(type, format, name);
        Py_DECREF(type);
    }
}

bool has_arguments(Py_ssize_t given, Py_ssize_t expected) {
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
static bool is_short(const PyPool *self, int length) {
    return length != NEVER_SHORT && pool_is_quick(&self->pool, length);
}

bool explain_entry(Entry entry) {
    if (entry == ENTRY_CLOSED) {
        raise_simulation_error("the %s is closed", "pool");
    } else if (entry == ENTRY_INSIDE) {
        PyErr_SetString(PyExc_RuntimeError, "an FMU has called the pool that it is in");
    }
    return entry == ENTRY_ENTERED;
}

bool perform(PyPool *self, int length, Work *work, void *context) {
    Entry entry = pool_try_enter(&self->pool);

    if (entry == ENTRY_ENTERED && is_short(self, length)) {
        work(self, true, context);
        pool_leave(&self->pool);
    } else if (entry == ENTRY_ENTERED || entry == ENTRY_BUSY) {
        Py_BEGIN_ALLOW_THREADS entry = entry == ENTRY_BUSY ? pool_enter(&self->pool) : entry;
        if (entry == ENTRY_ENTERED) {
            work(self, false, context);
            pool_leave(&self->pool);
        }
        Py_END_ALLOW_THREADS
    }
    return explain_entry(entry);
}
