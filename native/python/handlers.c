/* Signals that arrive while an FMU works whose code is Python.
 *
 * Python runs the handlers of signals between any two of its instructions on the main thread, also
 * between those of such an FMU. What a handler raises there, as for Ctrl-C, goes to the FMU, and is lost:
 * the FMU tells that it has failed. So handlers only note that the signal came while it works, and the
 * handlers of the caller run after the call. */

#include "python/handlers.h"

enum { MOST_SIGNALS = 128 };

/* The GIL guards them. */
static PyObject *set_handler, *get_handler, *main_thread, *current_frame;
static bool noted[MOST_SIGNALS];

static PyObject *note(PyObject *module, PyObject *args) {
    int number;
    PyObject *frame;

    (void)module;
    if (!PyArg_ParseTuple(args, "iO", &number, &frame)) {
        return NULL;
    }
    if (number > 0 && number < MOST_SIGNALS) {
        noted[number] = true;
    }
    Py_RETURN_NONE;
}

static PyObject *noting;

bool handlers_prepare(void) {
    static PyMethodDef method = {"note_signal", note, METH_VARARGS, NULL};

    set_handler = find_object("_signal", "signal");
    get_handler = find_object("_signal", "getsignal");
    main_thread = find_object("threading", "main_thread");
    current_frame = find_object("sys", "_getframe");
    noting = PyCFunction_New(&method, NULL);
    return set_handler != NULL && get_handler != NULL && main_thread != NULL &&
           current_frame != NULL && noting != NULL;
}

/* Sets whether this is the main thread: only there does Python run handlers. This function of Python may
 * do so as well: returns false with what one has raised. */
static bool ask_for_main_thread(bool *is_main) {
    PyObject *thread = PyObject_CallNoArgs(main_thread);
    PyObject *number = thread == NULL ? NULL : PyObject_GetAttrString(thread, "ident");

    *is_main = number != NULL && PyLong_AsUnsignedLong(number) == PyThread_get_thread_ident();
    Py_XDECREF(thread);
    Py_XDECREF(number);
    return !PyErr_Occurred();
}

/* The handler of a signal if it is Python's, and does not only note it already; or NULL. */
static PyObject *handler_of(int number) {
    PyObject *handler = PyObject_CallFunction(get_handler, "i", number);

    if (handler == NULL || handler == noting || !PyCallable_Check(handler)) {
        PyErr_Clear(); /* there is no signal of this number */
        Py_XDECREF(handler);
        return NULL;
    }
    return handler;
}

/* Python first runs the handlers of signals that have arrived, which may raise. */
static bool set(int number, PyObject *handler) {
    PyObject *before = PyObject_CallFunction(set_handler, "iO", number, handler);

    Py_XDECREF(before);
    return before != NULL;
}

bool handlers_hold(Held *held) {
    bool is_main;

    held->count = 0;
    held->raised = NULL;
    if (!ask_for_main_thread(&is_main)) {
        return false;
    }
    if (!is_main) {
        return true;
    }
    for (int number = 1; number < MOST_SIGNALS && held->count < MOST_HELD; number++) {
        PyObject *handler = handler_of(number);
        if (handler == NULL) {
            continue;
        }
        if (!set(number, noting)) {
            Py_DECREF(handler);
            handlers_release(held);
            return false;
        }
        held->numbers[held->count] = number;
        held->handlers[held->count++] = handler;
    }
    return true;
}

/* Keeps an exception if there was none before. */
typedef struct {
    PyObject *type, *value, *traceback;
} Raised;

static void keep(Raised *first) {
    if (first->type == NULL) {
        PyErr_Fetch(&first->type, &first->value, &first->traceback);
    }
    PyErr_Clear();
}

/* Whether the FMU has set no other handler. */
static bool is_held(int number) {
    PyObject *handler = PyObject_CallFunction(get_handler, "i", number);

    Py_XDECREF(handler);
    return handler == noting;
}

/* A handler that is back already may raise while the next one comes back. */
static void give_back(const Held *held, Raised *first) {
    for (size_t i = 0; i < held->count; i++) {
        while (is_held(held->numbers[i]) && !set(held->numbers[i], held->handlers[i])) {
            keep(first);
        }
    }
}

static void run(int number, PyObject *handler, Raised *first) {
    PyObject *frame = PyObject_CallNoArgs(current_frame);
    PyObject *result = frame == NULL ? NULL : PyObject_CallFunction(handler, "iO", number, frame);

    if (result == NULL) {
        keep(first);
    }
    Py_XDECREF(frame);
    Py_XDECREF(result);
}

/* Handlers that shall not run now do so at the next moment at which Python runs them. */
static void release(Held *held, bool now, Raised *first) {
    keep(first);
    give_back(held, first);
    for (size_t i = 0; i < held->count; i++) {
        const int number = held->numbers[i];
        if (noted[number]) {
            noted[number] = false;
            if (now && first->type == NULL) {
                run(number, held->handlers[i], first);
            } else {
                PyErr_SetInterruptEx(number);
            }
        }
        Py_DECREF(held->handlers[i]);
    }
    held->count = 0;
    PyErr_Restore(first->type, first->value, first->traceback);
}

bool handlers_release(Held *held) {
    Raised first = {.type = NULL};

    release(held, true, &first);
    return first.type == NULL;
}

void handlers_hold_at_the_end(Held *held) {
    PyObject *first = NULL;
    bool holds = handlers_hold(held);

    /* It fails once a signal, and always when Python itself ends: no handler runs then. */
    for (int tries = 0; !holds && tries < MOST_SIGNALS; tries++) {
        PyObject *type, *value, *traceback;

        PyErr_Fetch(&type, &value, &traceback);
        PyErr_NormalizeException(&type, &value, &traceback);
        Py_XDECREF(type);
        Py_XDECREF(traceback);
        if (first == NULL) {
            first = value;
        } else {
            Py_XDECREF(value);
        }
        holds = handlers_hold(held);
    }
    if (holds) {
        held->raised = first;
    } else {
        PyErr_Clear();
        Py_XDECREF(first);
    }
}

static int raise(void *value) {
    PyObject *error = value;

    PyErr_SetObject((PyObject *)Py_TYPE(error), error);
    Py_DECREF(error);
    return -1;
}

void handlers_postpone(Held *held) {
    PyObject *raised = held->raised;
    Raised first = {.type = NULL};

    release(held, false, &first);
    if (raised != NULL && Py_AddPendingCall(raise, raised) != 0) {
        Py_DECREF(raised); /* too much else is to be done */
    }
}
