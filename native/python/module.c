/* The extension module fmugym._native. See fmugym/_native.pyi. */

#include "python/programs.h"

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
    {"evaluate", py_evaluate, METH_VARARGS, NULL},
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

static bool add_type(PyObject *module, PyTypeObject **type, PyType_Spec *spec) {
    *type = (PyTypeObject *)PyType_FromSpec(spec);
    return *type != NULL && PyModule_AddType(module, *type) == 0;
}

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
    static PyTypeObject *pool_type;
    PyObject *module = PyModule_Create(&definition);

    if (module == NULL) {
        return NULL;
    }
    pool_prepare_process();
    if (!add_type(module, &access_type, &access_spec) ||
        !add_type(module, &draws_type, &draws_spec) ||
        !add_type(module, &pool_type, &pool_spec) || !add_constants(module)) {
        Py_DECREF(module);
        return NULL;
    }
    return module;
}
