/* The module: messages to bytes and back (`_coder.c`, `_body.c`), the way out (`_fast_send.c`)
   and in (`_fast_receive.c`), rings (`_broadcast.c`, `_ring_reader.c`), sockets, and the making of messages (`_construct.c`). */

#define CORTEX_IMPORTS_NUMPY
#include "_native.h"
#include "_numpy.h"

static struct PyModuleDef native_module = {
    PyModuleDef_HEAD_INIT,
    .m_name = "cortex._native",
    .m_doc = "The way of a message, in C.",
    .m_size = -1,
};

PyMODINIT_FUNC PyInit__native(void) {
    import_array();
    PyObject *module = PyModule_Create(&native_module);
    if (module == NULL) return NULL;
    if (PyModule_AddIntConstant(module, "INTERFACE", 21) < 0 /* compiled.py compares it */
        || add_broadcast(module) < 0 || add_coder(module) < 0 || add_construct(module) < 0 || add_fast_send(module) < 0
        || add_fast_receive(module) < 0 || add_ring_reader(module) < 0 || add_socket(module) < 0) {
        Py_DECREF(module);
        return NULL;
    }
    return module;
}
