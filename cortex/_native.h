/* What the C files of `cortex._native` share. */

#ifndef CORTEX_NATIVE_H
#define CORTEX_NATIVE_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stddef.h>

/* Each adds its names to the module; 0, or -1 with an error set. */
int add_construct(PyObject *module);
int add_socket(PyObject *module);

/* Where objects of a class keep a field that is one of its slots; -1 with an error set if it is none. */
Py_ssize_t slot_of(PyTypeObject *cls, PyObject *name);

extern PyTypeObject SocketType;

/* The next frame of a `Socket` as bytes; NULL if there is none, perhaps with an error set. If it may wait, it does so
   without the GIL, for as long as the socket's RCVTIMEO says. */
PyObject *socket_take(PyObject *socket, int may_wait);

#endif
