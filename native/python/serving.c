/* The functions of the module that make a process a worker: see worker/worker.h. */

#include <stdio.h>
#include <stdlib.h>

#include "python/python.h"

#include "worker/process.h"
#include "worker/worker.h"

/* Serves requests until the channel closes. The worker is not freed: the process ends then. */
PyObject *py_serve(PyObject *module, PyObject *args) {
    long long descriptor;
    int memory;
    Worker *worker = calloc(1, sizeof *worker);

    (void)module;
    if (worker == NULL) {
        return PyErr_NoMemory();
    }
    if (!PyArg_ParseTuple(args, "Li:serve", &descriptor, &memory)) {
        free(worker);
        return NULL;
    }
    channel_open(&worker->channel, descriptor);
    worker->memory = memory;
    setvbuf(stdout, NULL, _IOLBF, BUFSIZ); /* a crash would lose what is buffered */
    Py_BEGIN_ALLOW_THREADS worker_serve(worker);
    fflush(NULL); /* a line without an end */
    Py_END_ALLOW_THREADS Py_RETURN_NONE;
}

PyObject *py_end_with(PyObject *module, PyObject *number) {
    const long long parent = PyLong_AsLongLong(number);

    (void)module;
    return PyErr_Occurred() ? NULL : PyBool_FromLong(process_end_with(parent));
}

PyObject *py_stop_tracing(PyObject *module, PyObject *args) {
    int process, stopped_by;

    (void)module;
    if (!PyArg_ParseTuple(args, "ii:stop_tracing", &process, &stopped_by)) {
        return NULL;
    }
    process_let_go(process, stopped_by);
    Py_RETURN_NONE;
}
