/* Shared by the files that present the pool to Python. No file of another folder includes Python.h. */

#ifndef FMUGYM_PYTHON_H
#define FMUGYM_PYTHON_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#if defined Py_GIL_DISABLED
#error "Python without the GIL is not supported: the GIL guards the objects of this extension"
#endif

#include "pool/pool_form.h"
#include "program/draws.h"
#include "python/buffers.h"

enum { INPUTS, OUTPUTS, STATUS, OBSERVATIONS, HEALTH, BUFFERS };

typedef struct {
    PyObject_HEAD Access access;
} PyAccess;

typedef struct {
    PyObject_HEAD Draws draws;
    PyObject *form; /* the memory of the draws, of type bytes */
} PyDraws;

typedef struct {
    PyObject_HEAD Pool pool;
    bool needs_closing;
    Opening opening;
    PyObject *callback;
    Py_buffer buffers[BUFFERS];
    PyObject *playing; /* a capsule, so that a running call can keep its own reference */
} PyPool;

extern PyTypeObject *access_type, *draws_type;
extern PyType_Spec access_spec, draws_spec, pool_spec;

/* Returns whether an object is an access for this pool. Sets an exception if not. */
bool require_access(const PyPool *self, PyObject *object);

PyObject *decode(const char *text);
/* Takes the arguments of a new pool, all but the opening of it. Returns false with an exception. */
bool take_pool_arguments(PyPool *self, PyObject *args);
bool require_arguments(Py_ssize_t given, Py_ssize_t expected);

/* Calls. Work runs inside the pool, either with the GIL (alone) or without it. No thread waits
 * for the pool while it holds the GIL, because the thread inside may need the GIL. */

typedef void Work(PyPool *self, bool alone, void *context);

enum { NO_OPERATION = -1 };

/* Does some work: one of the operations of pool/pool.h, whose duration the pool knows, or
 * NO_OPERATION. Returns false with an exception if the pool cannot be entered. */
bool perform(PyPool *self, int operation, Work *work, void *context);
/* Sets the exception of an entry that was refused. Returns whether it was not. */
bool explain_entry(Entry entry);

/* Passes the messages of FMUs to Python. Returns false with an exception if that was
 * interrupted. */
bool report_messages(PyPool *self);

/* The methods of a pool */

PyObject *py_step(PyObject *object, PyObject *mask);
PyObject *py_reset(PyObject *object, PyObject *const *args, Py_ssize_t nargs);
PyObject *py_ask(PyObject *object, PyObject *args);
PyObject *py_count_steps(PyObject *object, PyObject *unused);

PyObject *py_prepare_play(PyObject *object, PyObject *args, PyObject *kwargs);
PyObject *py_start(PyObject *object, PyObject *mask);
PyObject *py_play(PyObject *object, PyObject *const *args, Py_ssize_t nargs);
PyObject *py_check_actions(PyObject *object, PyObject *actions);
PyObject *py_play_before(PyObject *object, PyObject *actions);
PyObject *py_play_after(PyObject *object, PyObject *unused);

/* The functions of the module that make a process a worker */

PyObject *py_serve(PyObject *module, PyObject *args);
PyObject *py_end_with(PyObject *module, PyObject *number);
PyObject *py_stop_tracing(PyObject *module, PyObject *args);

#endif
