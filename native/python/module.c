/* The extension module fmugym._native. See fmugym/_native.pyi. */

#include "python/python.h"

#include "pool/threads.h"

static PyObject *names_of(const char *const *texts, Py_ssize_t count) {
    PyObject *names = PyTuple_New(count);

    for (Py_ssize_t i = 0; names != NULL && i < count; i++) {
        PyObject *name = decode(texts[i]);
        if (name == NULL || PyTuple_SetItem(names, i, name) < 0) {
            Py_CLEAR(names);
        }
    }
    return names;
}

static PyObject *statistics(PyObject *module, PyObject *unused) {
    const ThreadStatistics s = threads_statistics();

    (void)module;
    (void)unused;
    return Py_BuildValue("{sKsKsKsK}", "jobs", (unsigned long long)s.jobs, "wakes",
                         (unsigned long long)s.wakes, "early_wakes",
                         (unsigned long long)s.early_wakes, "chunks",
                         (unsigned long long)s.chunks);
}

static PyObject *initializations(PyObject *module, PyObject *unused) {
    (void)module;
    (void)unused;
    return PyLong_FromUnsignedLongLong(number_of_initializations());
}

static PyMethodDef functions[] = {
    {"access", py_access, METH_O, NULL},
    {"evaluate", py_evaluate, METH_VARARGS, NULL},
    {"draw", py_draw, METH_VARARGS, NULL},
    {"draw_from", py_draw_from, METH_VARARGS, NULL},
    {"statistics", statistics, METH_NOARGS, NULL},
    {"initializations", initializations, METH_NOARGS, NULL},
    {"serve", py_serve, METH_VARARGS, NULL},
    {"end_with", py_end_with, METH_O, NULL},
    {"stop_tracing", py_stop_tracing, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    .m_base = PyModuleDef_HEAD_INIT,
    .m_name = "fmugym._native",
    .m_doc = "Pools of FMU instances in C.",
    .m_size = -1,
    .m_methods = functions,
};

static bool add_names(PyObject *module, const char *name, const char *const *texts,
                      Py_ssize_t count) {
    PyObject *names = names_of(texts, count);
    const bool added = PyModule_AddObjectRef(module, name, names) == 0; /* not if it is NULL */

    Py_XDECREF(names);
    return added;
}

static bool add_constants(PyObject *module) {
    return add_names(module, "OPERATIONS", operation_names, NUMBER_OF_OPERATIONS) &&
           add_names(module, "DISTRIBUTIONS", kind_names, NUMBER_OF_KINDS) &&
           PyModule_AddIntConstant(module, "MOST_REGISTERS", PROGRAM_REGISTERS) == 0;
}

PyMODINIT_FUNC PyInit__native(void) {
    PyObject *module = PyModule_Create(&definition);
    PyObject *pool_type = PyType_FromSpec(&pool_spec);

    pool_prepare_process();
    if (module == NULL || pool_type == NULL ||
        PyModule_AddType(module, (PyTypeObject *)pool_type) < 0 || !add_constants(module)) {
        Py_CLEAR(module);
    }
    Py_XDECREF(pool_type);
    return module;
}
