/* Single frames through a ZeroMQ socket, without pyzmq in between.

   pyzmq raises an exception where a socket is empty, which costs more than to receive several messages, and checks
   arguments that we never pass. So the few functions that a message needs are looked up in the libzmq that pyzmq has
   loaded. The socket stays pyzmq's: who made a `Socket` closes that first. Not for several threads at once. */

#include "_native.h"

#include <dlfcn.h>
#include <errno.h>
#include <string.h>

enum { DONTWAIT = 1 };

/* As zmq.h has it since libzmq 4.1: 64 bytes, aligned like a pointer. */
typedef union {
    unsigned char bytes[64];
    void *alignment;
} ZmqMessage;

static struct {
    int (*init)(ZmqMessage *);
    int (*init_size)(ZmqMessage *, size_t);
    int (*close)(ZmqMessage *);
    void *(*data)(ZmqMessage *);
    size_t (*size)(const ZmqMessage *);
    int (*receive)(ZmqMessage *, void *, int);
    int (*send)(ZmqMessage *, void *, int);
    int (*error)(void);
} zmq;

typedef struct {
    PyObject_HEAD
    void *handle; /* NULL: closed */
    PyObject *again, *failed;
} Socket;

/* Raise what pyzmq would for the last error; signals are handled first. */
static void raise_last(const Socket *socket) {
    const int number = zmq.error();
    if (number == EINTR && PyErr_CheckSignals() < 0) return;
    PyObject *exception = PyObject_CallFunction(socket->failed, "i", number);
    if (exception == NULL) return;
    PyErr_SetObject((PyObject *)Py_TYPE(exception), exception);
    Py_DECREF(exception);
}

static int is_open(const Socket *socket) {
    if (socket->handle != NULL) return 1;
    PyObject *exception = PyObject_CallFunction(socket->failed, "i", ENOTSOCK);
    if (exception != NULL) PyErr_SetObject((PyObject *)Py_TYPE(exception), exception);
    Py_XDECREF(exception);
    return 0;
}

PyObject *socket_take(PyObject *self, int may_wait) {
    Socket *socket = (Socket *)self;
    if (!is_open(socket)) return NULL;
    ZmqMessage message;
    zmq.init(&message);
    int size;
    if (may_wait) {
        Py_BEGIN_ALLOW_THREADS
        size = zmq.receive(&message, socket->handle, 0);
        Py_END_ALLOW_THREADS
        if (size < 0 && zmq.error() == EINTR) {
            PyErr_CheckSignals(); /* may set an error; else it counts as nothing received */
            zmq.close(&message);
            return NULL;
        }
    } else {
        do size = zmq.receive(&message, socket->handle, DONTWAIT);
        while (size < 0 && zmq.error() == EINTR);
    }
    PyObject *frame = NULL;
    if (size >= 0) {
        frame = PyBytes_FromStringAndSize(zmq.data(&message), (Py_ssize_t)zmq.size(&message));
    } else if (zmq.error() != EAGAIN) {
        raise_last(socket);
    }
    zmq.close(&message);
    return frame;
}

static PyObject *socket_receive(Socket *socket, PyObject *flags) {
    const long wanted = PyLong_AsLong(flags);
    if (wanted == -1 && PyErr_Occurred()) return NULL;
    PyObject *frame = socket_take((PyObject *)socket, !(wanted & DONTWAIT));
    if (frame == NULL && !PyErr_Occurred()) PyErr_SetNone(socket->again);
    return frame;
}

static PyObject *socket_send(Socket *socket, PyObject *const *arguments, Py_ssize_t count) {
    if (count < 1 || count > 2 || !PyBytes_CheckExact(arguments[0])) {
        PyErr_SetString(PyExc_TypeError, "expected a frame as bytes, and flags");
        return NULL;
    }
    const long flags = count == 2 ? PyLong_AsLong(arguments[1]) : 0;
    if ((flags == -1 && PyErr_Occurred()) || !is_open(socket)) return NULL;
    const Py_ssize_t size = PyBytes_GET_SIZE(arguments[0]);
    ZmqMessage message;
    if (zmq.init_size(&message, (size_t)size) < 0) return PyErr_NoMemory();
    memcpy(zmq.data(&message), PyBytes_AS_STRING(arguments[0]), (size_t)size);
    int sent;
    if (flags & DONTWAIT) {
        do sent = zmq.send(&message, socket->handle, (int)flags);
        while (sent < 0 && zmq.error() == EINTR);
    } else {
        Py_BEGIN_ALLOW_THREADS
        sent = zmq.send(&message, socket->handle, (int)flags);
        Py_END_ALLOW_THREADS
    }
    if (sent >= 0) Py_RETURN_NONE; /* the message is libzmq's now */
    if (zmq.error() == EAGAIN) {
        PyErr_SetNone(socket->again);
    } else {
        raise_last(socket);
    }
    zmq.close(&message);
    return NULL;
}

static PyObject *socket_close(Socket *socket, PyObject *unused) {
    (void)unused;
    socket->handle = NULL;
    Py_RETURN_NONE;
}

/* Look the functions up in what a loaded library depends on; 0 with an error set if one is missing. */
static int find_functions(const char *library) {
    void *loaded = dlopen(library, RTLD_LAZY | RTLD_NOLOAD);
    if (loaded == NULL) {
        PyErr_Format(PyExc_OSError, "%s is not loaded", library);
        return 0;
    }
    const struct {
        void *place;
        const char *name;
    } functions[] = {
        {&zmq.init, "zmq_msg_init"},     {&zmq.init_size, "zmq_msg_init_size"}, {&zmq.close, "zmq_msg_close"},
        {&zmq.data, "zmq_msg_data"},     {&zmq.size, "zmq_msg_size"},           {&zmq.receive, "zmq_msg_recv"},
        {&zmq.send, "zmq_msg_send"},     {&zmq.error, "zmq_errno"},
    };
    for (size_t index = 0; index < sizeof functions / sizeof *functions; ++index) {
        void *found = dlsym(loaded, functions[index].name);
        if (found == NULL) {
            PyErr_Format(PyExc_OSError, "%s has no %s", library, functions[index].name);
            return 0; /* `loaded` is kept: it is loaded anyway */
        }
        memcpy(functions[index].place, &found, sizeof found);
    }
    return 1;
}

static PyObject *socket_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"underlying", "library", "again", "failed", NULL};
    PyObject *underlying, *again, *failed;
    const char *library;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "OsOO:Socket", names, &underlying, &library, &again, &failed)) {
        return NULL;
    }
    void *handle = PyLong_AsVoidPtr(underlying);
    if (PyErr_Occurred() || (zmq.error == NULL && !find_functions(library))) return NULL;
    Socket *socket = (Socket *)type->tp_alloc(type, 0);
    if (socket == NULL) return NULL;
    socket->handle = handle;
    socket->again = Py_NewRef(again);
    socket->failed = Py_NewRef(failed);
    return (PyObject *)socket;
}

static void socket_dealloc(Socket *socket) {
    Py_XDECREF(socket->again);
    Py_XDECREF(socket->failed);
    Py_TYPE(socket)->tp_free((PyObject *)socket);
}

static PyMethodDef socket_methods[] = {
    {"receive", (PyCFunction)socket_receive, METH_O, "Take the next frame; `again` if there is none."},
    {"send", (PyCFunction)(void (*)(void))socket_send, METH_FASTCALL, "Send a frame; `again` if there is no room."},
    {"close", (PyCFunction)socket_close, METH_NOARGS, "Use the socket no more."},
    {NULL, NULL, 0, NULL},
};

PyTypeObject SocketType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Socket",
    .tp_doc = "Socket(underlying, library, again, failed)\n--\n\n"
              "Sends and takes single frames.\n\n"
              "Args:\n"
              "    underlying: Address of the libzmq socket.\n"
              "    library: Path of pyzmq's own extension, which libzmq was loaded with.\n"
              "    again: Raised where there is no frame, or no room.\n"
              "    failed: Called with an errno; makes the exception of any other failure.\n",
    .tp_basicsize = sizeof(Socket),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_new = socket_new,
    .tp_dealloc = (destructor)socket_dealloc,
    .tp_methods = socket_methods,
};

int add_socket(PyObject *module) {
    if (PyType_Ready(&SocketType) < 0) return -1;
    return PyModule_AddObjectRef(module, "Socket", (PyObject *)&SocketType);
}
