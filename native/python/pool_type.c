/* The type Pool: making, closing and entering pools, and reporting the messages of their FMUs. */

#include <stdlib.h>
#include <string.h>

#include "python.h"

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

static bool explain(Entry entry) {
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
    return explain(entry);
}

/* Closing */

/* Returns false with an exception if reporting the last messages was interrupted, or if an FMU
 * closes its own pool. */
static bool close_pool(PyPool *self) {
    Entry entry;

    Py_BEGIN_ALLOW_THREADS entry = pool_enter(&self->pool);
    if (entry == ENTRY_ENTERED) {
        pool_close(&self->pool);
        pool_leave(&self->pool);
    }
    Py_END_ALLOW_THREADS if (entry != ENTRY_ENTERED) {
        return entry == ENTRY_CLOSED || explain(entry);
    }
    const bool reported = report_messages(self);
    log_close(&self->pool.log);
    return reported;
}

PyObject *py_close(PyObject *object, PyObject *unused) {
    (void)unused;
    if (!close_pool((PyPool *)object)) {
        return NULL;
    }
    Py_RETURN_NONE;
}

/* An exception may already be set when this is called. This function cannot raise another one. */
static void close_at_the_end(PyPool *self) {
    PyObject *type, *value, *traceback;

    PyErr_Fetch(&type, &value, &traceback);
    if (!close_pool(self)) {
        PyErr_WriteUnraisable(NULL);
    }
    pool_dispose(&self->pool);
    PyErr_Restore(type, value, traceback);
}

static void pool_dealloc(PyObject *object) {
    PyPool *self = (PyPool *)object;
    PyTypeObject *type = Py_TYPE(object);
    freefunc release_memory = (freefunc)PyType_GetSlot(type, Py_tp_free);

    if (self->opened) {
        close_at_the_end(self);
    }
    for (int i = 0; i < BUFFERS; i++) {
        release_buffer(&self->buffers[i]);
    }
    drop_system(self->system);
    free(self->paths);
    free(self->categories);
    Py_XDECREF(self->playing);
    Py_XDECREF(self->single);
    Py_XDECREF(self->actions[0]);
    Py_XDECREF(self->actions[1]);
    Py_XDECREF(self->arguments);
    release_memory(object);
    Py_DECREF(type);
}

/* Making */

static bool open_pool(PyPool *self) {
    const Settings settings = self->pool.settings;
    char error[8192];
    bool opened;

    self->opened = true;
    Py_BEGIN_ALLOW_THREADS opened = pool_open(&self->pool, &settings, error, sizeof error);
    Py_END_ALLOW_THREADS if (!report_messages(self)) {
        return false;
    }
    if (!opened) {
        PyObject *text = decode(error);
        PyErr_SetObject(PyExc_OSError, text);
        Py_XDECREF(text);
    }
    return opened;
}

static PyObject *pool_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) {
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyPool *self = (PyPool *)allocate(type, 0);

    if (self != NULL && take_pool_arguments(self, args, kwargs) && open_pool(self)) {
        return (PyObject *)self;
    }
    Py_XDECREF((PyObject *)self);
    return NULL;
}

static PyMethodDef methods[] = {
#define FAST(name, function) {name, (PyCFunction)(void (*)(void))function, METH_FASTCALL, NULL}
    {"step_own", py_step_own, METH_NOARGS, NULL},
    FAST("step", py_step),
    FAST("reset", py_reset),
    FAST("step_or_reset", py_step_or_reset),
    {"prepare_play", (PyCFunction)(void (*)(void))py_prepare_play, METH_VARARGS | METH_KEYWORDS,
     NULL},
    FAST("play", py_play),
    FAST("play_before", py_play_before),
    FAST("play_after", py_play_after),
    FAST("rollout", py_rollout),
    {"exchange_play", py_exchange_play, METH_O, NULL},
    {"prepare_single", (PyCFunction)(void (*)(void))py_prepare_single,
     METH_VARARGS | METH_KEYWORDS, NULL},
    FAST("step_single", py_step_single),
    FAST("before_single", py_before_single),
    {"after_single", py_after_single, METH_O, NULL},
    {"begin_single", py_begin_single, METH_O, NULL},
    {"actions_of_single", py_actions_of_single, METH_NOARGS, NULL},
    FAST("start", py_start),
    {"reset_by", py_reset_by, METH_O, NULL},
    {"save", py_save, METH_NOARGS, NULL},
    FAST("restore", py_restore),
    FAST("read", py_read),
    FAST("write", py_write),
    {"failure", py_failure, METH_O, NULL},
    FAST("knows_start", py_knows_start),
    FAST("bundle", py_bundle),
    FAST("unbundle", py_unbundle),
    {"keep_records", py_keep_records, METH_NOARGS, NULL},
    {"record_of", py_record_of, METH_O, NULL},
    {"replace_record", (PyCFunction)(void (*)(void))py_replace_record, METH_FASTCALL, NULL},
    {"count_steps", py_count_steps, METH_NOARGS, NULL},
    {"recycle", py_recycle, METH_NOARGS, NULL},
    FAST("record", py_record),
    FAST("begin_by", py_begin_by),
    {"close", py_close, METH_NOARGS, NULL},
    {"costs", py_costs, METH_NOARGS, NULL},
    {"uses_states", py_uses_states, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot slots[] = {
    {Py_tp_new, (void *)pool_new},
    {Py_tp_dealloc, (void *)pool_dealloc},
    {Py_tp_methods, methods},
    {0, NULL},
};

PyType_Spec pool_spec = {"fmugym._native.Pool", sizeof(PyPool), 0, Py_TPFLAGS_DEFAULT, slots};
