/* Entering pools, and reporting the messages of their FMUs. */

#include <string.h>

#include "python.h"

PyObject *closed_error;

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

/* The recording of an episode goes to Python likewise. */

static void do_take_tape(PyPool *self, bool alone, void *context) {
    Tape *taken = context;
    (void)alone;
    *taken = self->pool.tape;
    memset(&self->pool.tape, 0, sizeof self->pool.tape);
}

static PyObject *tape_as_tuple(const Tape *t) {
    const Py_ssize_t starts = (Py_ssize_t)t->number_of_starts, rows = (Py_ssize_t)t->rows;
    const Py_ssize_t in = (Py_ssize_t)t->width_in, out = (Py_ssize_t)t->width_out;
    const Py_ssize_t number = sizeof(double);

    return Py_BuildValue("y#y#y#y#y#y#y#", (const char *)t->start_types, starts,
                         (const char *)t->start_variables, starts * (Py_ssize_t)sizeof(Element),
                         (const char *)t->starts, starts * number, (const char *)t->first_outputs,
                         out * number, (const char *)t->inputs, rows * in * number,
                         (const char *)t->outputs, rows * out * number, (const char *)t->statuses,
                         rows);
}

static bool hand_over_tape(PyPool *self) {
    Tape taken = {0};

    if (!perform(self, ALWAYS_SHORT, do_take_tape, &taken)) {
        return false;
    }
    PyObject *tuple = taken.state == TAPE_READY ? tape_as_tuple(&taken) : Py_NewRef(Py_None);
    PyObject *result = NULL;
    tape_free(&taken);
    if (tuple != NULL && tuple != Py_None) {
        result = PyObject_CallFunctionObjArgs(self->listener, tuple, NULL);
    } else if (tuple == Py_None) {
        result = Py_NewRef(Py_None);
    }
    Py_XDECREF(tuple);
    Py_XDECREF(result);
    return result != NULL;
}

bool report_messages(PyPool *self) {
    const bool reported = !atomic_get(&self->pool.log.pending) || drain(self);
    return reported && (!atomic_get(&self->pool.tape.ready) || hand_over_tape(self));
}

/* Entering */

/* Getting the GIL back may take milliseconds if other Python threads are busy. So very short
 * work keeps the GIL. */
static bool is_short(const PyPool *self, int length) {
    return length == ALWAYS_SHORT || (length >= 0 && pool_is_quick(&self->pool, length));
}

bool explain_entry(Entry entry) {
    if (entry == ENTRY_CLOSED) {
        PyErr_SetString(closed_error, "the pool is closed");
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
