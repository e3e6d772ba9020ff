/* What the C files of `cortex._native` share. */

#ifndef CORTEX_NATIVE_H
#define CORTEX_NATIVE_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stddef.h>
#include <stdint.h>
#include <time.h>

enum {
    HEADER_SIZE = 64,
    HEAD_SIZE = 24, /* of a header: what all frames of a publisher begin with */
};

/* Each adds its names to the module; 0, or -1 with an error set. */
int add_broadcast(PyObject *module);
int add_coder(PyObject *module);
int add_construct(PyObject *module);
int add_fast_send(PyObject *module);
int add_fast_receive(PyObject *module);
int add_ring_reader(PyObject *module);
int add_socket(PyObject *module);

extern PyTypeObject SocketType;

/* The next frame of a `Socket` as bytes; NULL if there is none, perhaps with an error set. If it may wait, it does so
   without the GIL, for as long as the socket's RCVTIMEO says. */
PyObject *socket_take(PyObject *socket, int may_wait);

/* Whether to look without the lock: `receive` is that of a ring, which runs no Python code, and what comes next is the message
   that is expected, or nothing if one would not wait for it. Another frame is for Python code, before which somebody may get the
   lock who already waits for it, and take what follows. */
int may_look_unlocked(PyObject *receive, int may_wait, uint64_t expected);

/* The next frame that `receive` has, which raises `again` if it has none: then NULL without error. */
PyObject *take_frame(PyObject *receive, PyObject *again, int may_wait);

/* The clock of Python's `time.monotonic_ns`. */
static inline int64_t monotonic_ns(void) {
#ifdef __APPLE__
    return (int64_t)clock_gettime_nsec_np(CLOCK_UPTIME_RAW);
#else
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
#endif
}

/* Let go of what was made; None, or NULL if an error is set. */
static inline PyObject *none_or_error(PyObject *made) {
    Py_XDECREF(made);
    if (PyErr_Occurred()) return NULL;
    Py_RETURN_NONE;
}

/* Whether `locked` of a lock says that nobody has it. Who waits for it may have got it already, but runs no code before it has
   the GIL, too. */
static inline int is_free(PyObject *locked) {
    PyObject *answer = PyObject_CallNoArgs(locked);
    if (answer == NULL) PyErr_Clear();
    Py_XDECREF(answer);
    return answer == Py_False;
}

/* Give back a lock that is ours; keeps the error that is set, if one is. */
static inline void give_back(PyObject *release) {
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    PyObject *released = PyObject_CallNoArgs(release);
    if (released == NULL) PyErr_Clear();
    Py_XDECREF(released);
    PyErr_Restore(type, value, traceback);
}

/* What the types of this module do for the objects that they hold. */
static inline int visit_held(PyObject *const *held, size_t count, visitproc visit, void *arg) {
    for (size_t index = 0; index < count; ++index) Py_VISIT(held[index]);
    return 0;
}
static inline void clear_held(PyObject **held, size_t count) {
    for (size_t index = 0; index < count; ++index) Py_CLEAR(held[index]);
}

static inline int arguments_are(Py_ssize_t count, Py_ssize_t wanted) {
    if (count == wanted) return 1;
    PyErr_Format(PyExc_TypeError, "expected %zd arguments, got %zd", wanted, count);
    return 0;
}

#endif
