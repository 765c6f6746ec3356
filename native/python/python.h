/* Shared by the files that present the pool to Python. No file of another folder includes Python.h. */

#ifndef FMUGYM_PYTHON_H
#define FMUGYM_PYTHON_H

#include "python/arrays.h"

#if defined Py_GIL_DISABLED
#error "Python without the GIL is not supported: the GIL guards the objects of this extension"
#endif

#include "pool/pool_form.h"
#include "program/program_form.h"

typedef struct {
    PyObject_HEAD Pool pool;
    bool needs_closing;
    Opening opening;
    PyObject *callback;
    PyObject *arrays; /* a tuple of the pool's own; the next two are in two of them */
    Matrix inputs;
    float *observations;
    PyObject *playing; /* a capsule, so that a running call can keep its own reference */
} PyPool;

extern PyType_Spec pool_spec;

PyObject *decode(const char *text);
bool require_arguments(Py_ssize_t given, Py_ssize_t expected);
/* Sets an exception if there is a fault in a form. Returns whether there is none. */
bool require_no_fault(const char *form, const char *fault);

/* A reader of a form of type bytes, whose memory is aligned. */
Reader reader_of(PyObject *bytes);
/* Takes a capsule of py_access. Returns NULL with an exception if it is none for this pool. */
const Access *require_access(const PyPool *self, PyObject *capsule);
/* Reads draws, which refer to the form. The addresses of numpy's random_standard_normal and of exp may
 * be 0. Returns false with an exception if that fails. */
bool take_draws(PyObject *form, unsigned long long standard_normal, unsigned long long exponential,
                Draws *draws);
/* Whether all that draws set is among so many start values. Sets an exception if not. */
bool require_starts(const Draws *draws, npy_intp count);
/* Takes a tuple of vectors of this length as the rows of programs, which refer to them. Returns them, to
 * be freed by the caller, or NULL with an exception. */
Row *take_rows(PyObject *tuple, npy_intp length);
/* The matrix that an array is; it refers to the array. */
static inline Matrix matrix_of(PyArrayObject *array) {
    return (Matrix){PyArray_BYTES(array), PyArray_STRIDE(array, 0), PyArray_STRIDE(array, 1)};
}

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

PyObject *py_prepare_play(PyObject *object, PyObject *args);
PyObject *py_start(PyObject *object, PyObject *mask);
PyObject *py_play(PyObject *object, PyObject *const *args, Py_ssize_t nargs);
PyObject *py_check_actions(PyObject *object, PyObject *actions);
PyObject *py_play_before(PyObject *object, PyObject *actions);
PyObject *py_play_after(PyObject *object, PyObject *unused);

/* The functions of the module */

PyObject *py_access(PyObject *module, PyObject *form);
PyObject *py_evaluate(PyObject *module, PyObject *args);
PyObject *py_draw(PyObject *module, PyObject *args);
PyObject *py_draw_from(PyObject *module, PyObject *args);

/* Those that make a process a worker */

PyObject *py_serve(PyObject *module, PyObject *args);
PyObject *py_end_with(PyObject *module, PyObject *number);
PyObject *py_stop_tracing(PyObject *module, PyObject *args);

#endif
