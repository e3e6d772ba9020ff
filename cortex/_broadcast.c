/* A publisher's ring of frames and its readers, for Python; what they do is in `broadcast.h`, which C++ uses, too. */

#include "_broadcast.h"

#include "cpp/include/cortex/broadcast.h"

#include <poll.h>

enum { RING_BYTES = 1 << 19 };

static PyObject *dont_wait, *no_flags; /* of ZeroMQ, as ints */

typedef struct {
    PyObject_HEAD
    CortexWriter writer;
    PyObject *again;
    int open;
} Broadcast;

static PyTypeObject BroadcastType, RingReaderType;
static PyObject *reader_take(PyObject *self, int may_wait);

PyObject *take_frame(PyObject *receive, PyObject *again, int may_wait) {
    if (PyCFunction_CheckExact(receive)) { /* one of ours needs no exception */
        PyObject *self = PyCFunction_GET_SELF(receive);
        if (self != NULL && Py_IS_TYPE(self, &RingReaderType)) return reader_take(self, may_wait);
        if (self != NULL && Py_IS_TYPE(self, &SocketType)) return socket_take(self, may_wait);
    }
    PyObject *flags[2] = {NULL, may_wait ? no_flags : dont_wait};
    PyObject *frame = PyObject_Vectorcall(receive, flags + 1, 1 | PY_VECTORCALL_ARGUMENTS_OFFSET, NULL);
    if (frame == NULL && PyErr_ExceptionMatches(again)) PyErr_Clear();
    return frame;
}

/* The publisher's end */

static PyObject *cast_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"source", "again", NULL};
    unsigned long long source;
    PyObject *again;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "KO:Broadcast", names, &source, &again)) return NULL;
    Broadcast *cast = (Broadcast *)type->tp_alloc(type, 0);
    if (cast == NULL) return NULL;
    cast->again = Py_NewRef(again);
    if (cortex_writer_open(&cast->writer, source, RING_BYTES) < 0) {
        PyErr_SetFromErrno(PyExc_OSError);
        Py_DECREF(cast);
        return NULL;
    }
    cast->open = 1;
    return (PyObject *)cast;
}

static void cast_dealloc(Broadcast *cast) {
    if (cast->open) cortex_writer_close(&cast->writer);
    Py_XDECREF(cast->again);
    Py_TYPE(cast)->tp_free((PyObject *)cast);
}

static PyObject *cast_close(Broadcast *cast, PyObject *unused) {
    (void)unused;
    if (cast->open) cortex_writer_close(&cast->writer);
    cast->open = 0;
    Py_RETURN_NONE;
}

static int cast_is_open(const Broadcast *cast) {
    if (!cast->open) PyErr_SetString(PyExc_ValueError, "the ring is closed");
    return cast->open;
}

static PyObject *cast_add(Broadcast *cast, PyObject *arguments) {
    CortexHello hello = {0};
    int strict;
    unsigned long long first;
    if (!PyArg_ParseTuple(arguments, "iiipK:add", &hello.socket, &hello.page, &hello.bell, &strict, &first)
        || !cast_is_open(cast))
        return NULL;
    const int member = cortex_writer_add(&cast->writer, &hello, strict, first);
    return member < 0 ? PyErr_SetFromErrno(PyExc_OSError) : PyLong_FromLong(member);
}

/* A member by its number; NULL with an error set if there is no such. */
static CortexMember *cast_member(Broadcast *cast, PyObject *number) {
    const long member = PyLong_AsLong(number);
    if (member == -1 && PyErr_Occurred()) return NULL;
    if (!cast_is_open(cast)) return NULL;
    if (member >= 0 && member < cast->writer.count && cast->writer.members[member].used) return &cast->writer.members[member];
    PyErr_Format(PyExc_IndexError, "no member %ld", member);
    return NULL;
}

static PyObject *cast_remove(Broadcast *cast, PyObject *number) {
    CortexMember *member = cast_member(cast, number);
    if (member == NULL) return NULL;
    cortex_writer_remove(&cast->writer, (int)(member - cast->writer.members));
    Py_RETURN_NONE;
}

static PyObject *cast_send(Broadcast *cast, PyObject *const *arguments, Py_ssize_t count) {
    if (count < 1 || count > 2 || !PyBytes_CheckExact(arguments[0])) {
        PyErr_SetString(PyExc_TypeError, "expected a frame as bytes, and flags");
        return NULL;
    }
    if (!cast_is_open(cast)) return NULL;
    const int found = cortex_writer_put(&cast->writer, PyBytes_AS_STRING(arguments[0]), (size_t)PyBytes_GET_SIZE(arguments[0]), 0);
    if (found != CORTEX_FULL) return PyBool_FromLong(found == CORTEX_WRITTEN);
    PyErr_SetNone(cast->again);
    return NULL;
}

int broadcast_put(PyObject *send, const char *frame, Py_ssize_t size) {
    if (!PyCFunction_CheckExact(send)) return -1;
    PyObject *self = PyCFunction_GET_SELF(send);
    if (self == NULL || !Py_IS_TYPE(self, &BroadcastType) || !((Broadcast *)self)->open) return -1;
    return cortex_writer_put(&((Broadcast *)self)->writer, frame, (size_t)size, 1);
}

static PyObject *cast_end(Broadcast *cast, PyObject *frame) {
    if (!PyBytes_CheckExact(frame) || PyBytes_GET_SIZE(frame) != HEADER_SIZE) {
        PyErr_SetString(PyExc_TypeError, "expected a header as bytes");
        return NULL;
    }
    if (!cast_is_open(cast)) return NULL;
    cortex_writer_end(&cast->writer, PyBytes_AS_STRING(frame), HEADER_SIZE);
    Py_RETURN_NONE;
}

static PyObject *cast_in_the_way(Broadcast *cast, PyObject *size) {
    const Py_ssize_t bytes = PyLong_AsSsize_t(size);
    if ((bytes == -1 && PyErr_Occurred()) || !cast_is_open(cast)) return NULL;
    PyObject *found = PyList_New(0);
    for (int index = 0; found != NULL && index < cast->writer.count; ++index) {
        CortexMember *member = &cast->writer.members[index];
        if (!cortex_member_is_full(&cast->writer, member, cortex_entry_bytes((uint64_t)bytes) + CORTEX_SPARE_BYTES)) continue;
        PyObject *number = PyLong_FromLong(index);
        if (number == NULL || PyList_Append(found, number) < 0) Py_CLEAR(found);
        Py_XDECREF(number);
    }
    return found;
}

static PyObject *cast_give_up(Broadcast *cast, PyObject *number) {
    CortexMember *member = cast_member(cast, number);
    if (member == NULL) return NULL;
    member->late = 1;
    Py_RETURN_NONE;
}

static PyMethodDef cast_methods[] = {
    {"add", (PyCFunction)cast_add, METH_VARARGS, "Take in a reader by the descriptors of its hello, which become ours; its number."},
    {"remove", (PyCFunction)cast_remove, METH_O, "Forget a reader."},
    {"send", (PyCFunction)(void (*)(void))cast_send, METH_FASTCALL,
     "Send a frame to all; `again` if a reliable reader has no room, False if one is late and loses it."},
    {"end", (PyCFunction)cast_end, METH_O, "Send the last frame, for which there is room."},
    {"in_the_way", (PyCFunction)cast_in_the_way, METH_O, "The reliable readers that have no room for so many bytes."},
    {"give_up", (PyCFunction)cast_give_up, METH_O, "Wait for a reader no more, until it has read half."},
    {"close", (PyCFunction)cast_close, METH_NOARGS, "Let go of it; readers keep what is in it."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject BroadcastType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Broadcast",
    .tp_doc = "Broadcast(source, again)\n--\n\nA ring of frames in shared memory. The caller holds a lock.",
    .tp_basicsize = sizeof(Broadcast),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_new = cast_new,
    .tp_dealloc = (destructor)cast_dealloc,
    .tp_methods = cast_methods,
};

/* The subscriber's end */

typedef struct {
    PyObject_HEAD
    CortexReader ring;
    PyObject *receive, *again;
    int socket_fd, wait_ms;
    int open, told; /* that it is broken */
} RingReader;

/* The next frame as bytes; NULL if there is none, perhaps with an error. Then the bell rings when one comes. */
static PyObject *next_frame(RingReader *reader) {
    const uint8_t *data;
    int64_t size;
    if (!reader->open || reader->ring.ring == NULL) return NULL;
    while ((size = cortex_reader_peek(&reader->ring, &data)) > 0) {
        PyObject *frame = PyBytes_FromStringAndSize((const char *)data, (Py_ssize_t)size);
        if (frame == NULL) return NULL;
        if (cortex_reader_take(&reader->ring, size)) {
            cortex_reader_disarm(&reader->ring);
            return frame;
        }
        Py_DECREF(frame);
    }
    if (size == 0 || reader->told) return NULL;
    reader->told = 1;
    return PyBytes_FromStringAndSize(NULL, 0); /* no frame: the link rejects it, and sees why */
}

/* As `next_frame`, with the bell armed if there is none. */
static PyObject *next_or_arm(RingReader *reader) {
    while (1) {
        PyObject *frame = next_frame(reader);
        if (frame != NULL || PyErr_Occurred() || !reader->open || reader->ring.ring == NULL || reader->ring.broken
            || cortex_reader_arm(&reader->ring))
            return frame;
    }
}

/* Wait for the bell or the socket, without the GIL; 0 with an error set. */
static int reader_wait(RingReader *reader) {
    struct pollfd sources[2] = {{reader->ring.bell, POLLIN, 0}, {reader->socket_fd, POLLIN, 0}};
    const int wait_ms = reader->wait_ms;
    Py_BEGIN_ALLOW_THREADS
    poll(sources, 2, wait_ms);
    Py_END_ALLOW_THREADS
    return PyErr_CheckSignals() == 0;
}

/* The next frame, from the ring or else from the socket; NULL if there is none, perhaps with an error. */
static PyObject *reader_take(PyObject *self, int may_wait) {
    RingReader *reader = (RingReader *)self;
    PyObject *frame = next_or_arm(reader);
    if (frame != NULL || PyErr_Occurred()) return frame;
    frame = take_frame(reader->receive, reader->again, 0); /* after this its descriptor shows what comes */
    if (frame != NULL || PyErr_Occurred() || !may_wait || !reader_wait(reader)) return frame;
    frame = next_or_arm(reader);
    return frame != NULL || PyErr_Occurred() ? frame : take_frame(reader->receive, reader->again, 0);
}

static PyObject *reader_receive(RingReader *reader, PyObject *flags) {
    const long wanted = PyLong_AsLong(flags);
    if (wanted == -1 && PyErr_Occurred()) return NULL;
    PyObject *frame = reader_take((PyObject *)reader, !(wanted & 1));
    if (frame == NULL && !PyErr_Occurred()) PyErr_SetNone(reader->again);
    return frame;
}

static PyObject *reader_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"path", "source", "number", "socket_fd", "receive", "again", "wait_ms", NULL};
    const char *path;
    unsigned long long source, number;
    int socket_fd, wait_ms;
    PyObject *receive, *again;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "sKKiOOi:RingReader", names, &path, &source, &number, &socket_fd,
                                     &receive, &again, &wait_ms))
        return NULL;
    RingReader *reader = (RingReader *)type->tp_alloc(type, 0);
    if (reader == NULL) return NULL;
    reader->socket_fd = socket_fd;
    reader->wait_ms = wait_ms;
    reader->receive = Py_NewRef(receive);
    reader->again = Py_NewRef(again);
    if (cortex_reader_open(&reader->ring, path, source, number) < 0) {
        PyErr_SetFromErrnoWithFilename(PyExc_OSError, path);
        Py_DECREF(reader);
        return NULL;
    }
    reader->open = 1;
    return (PyObject *)reader;
}

static PyObject *reader_close(RingReader *reader, PyObject *unused) {
    (void)unused;
    if (reader->open) cortex_reader_close(&reader->ring);
    reader->open = 0;
    Py_RETURN_NONE;
}

static PyObject *reader_welcomed(RingReader *reader, PyObject *unused) {
    (void)unused;
    if (!reader->open || !cortex_reader_welcomed(&reader->ring)) Py_RETURN_NONE;
    return PyLong_FromUnsignedLongLong(reader->ring.first);
}

static int reader_traverse(RingReader *reader, visitproc visit, void *arg) {
    Py_VISIT(reader->receive);
    Py_VISIT(reader->again);
    return 0;
}

static int reader_clear(RingReader *reader) {
    Py_CLEAR(reader->receive);
    Py_CLEAR(reader->again);
    return 0;
}

static void reader_dealloc(RingReader *reader) {
    PyObject_GC_UnTrack(reader);
    reader_clear(reader);
    if (reader->open) cortex_reader_close(&reader->ring);
    Py_TYPE(reader)->tp_free((PyObject *)reader);
}

static PyObject *reader_broken(RingReader *reader, void *unused) {
    (void)unused;
    return PyBool_FromLong(reader->ring.broken);
}

static PyObject *reader_fd(RingReader *reader, void *unused) {
    (void)unused;
    return PyLong_FromLong(reader->ring.bell);
}

static PyGetSetDef reader_properties[] = {
    {"broken", (getter)reader_broken, NULL, "Whether there is something in the ring that is no frame.", NULL},
    {"fd", (getter)reader_fd, NULL, "Becomes readable when a frame comes after none was there.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyMethodDef reader_methods[] = {
    {"receive", (PyCFunction)reader_receive, METH_O, "Take the next frame; `again` if there is none."},
    {"welcomed", (PyCFunction)reader_welcomed, METH_NOARGS, "The sequence of the first message for us, once the publisher has taken us in; else None."},
    {"close", (PyCFunction)reader_close, METH_NOARGS, "Read no more."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject RingReaderType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.RingReader",
    .tp_doc = "RingReader(path, source, number, socket_fd, receive, again, wait_ms)\n--\n\n"
              "A subscriber's end of a publisher's ring: asks for it where the publisher's node listens.",
    .tp_basicsize = sizeof(RingReader),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .tp_new = reader_new,
    .tp_traverse = (traverseproc)reader_traverse,
    .tp_clear = (inquiry)reader_clear,
    .tp_dealloc = (destructor)reader_dealloc,
    .tp_methods = reader_methods,
    .tp_getset = reader_properties,
};

/* Where the node listens */

static PyObject *listen_at(PyObject *module, PyObject *path) {
    (void)module;
    const char *name = PyUnicode_AsUTF8(path);
    if (name == NULL) return NULL;
    const int fd = cortex_listen(name);
    return fd < 0 ? PyErr_SetFromErrnoWithFilenameObject(PyExc_OSError, path) : PyLong_FromLong(fd);
}

static PyObject *accept_one(PyObject *module, PyObject *listener) {
    (void)module;
    const int listening = (int)PyLong_AsLong(listener);
    if (listening == -1 && PyErr_Occurred()) return NULL;
    const int fd = cortex_accept(listening);
    if (fd < 0 && errno != EAGAIN) return PyErr_SetFromErrno(PyExc_OSError);
    return PyLong_FromLong(fd);
}

static PyObject *hear(PyObject *module, PyObject *socket) {
    (void)module;
    CortexHello hello;
    const int fd = (int)PyLong_AsLong(socket);
    if (fd == -1 && PyErr_Occurred()) return NULL;
    if (cortex_hear(fd, &hello) < 0) return PyErr_SetFromErrno(PyExc_OSError);
    return Py_BuildValue("KKii", (unsigned long long)hello.source, (unsigned long long)hello.reader, hello.page, hello.bell);
}

static PyMethodDef functions[] = {
    {"listen", listen_at, METH_O, "Listen at a path for readers; the descriptor."},
    {"accept", accept_one, METH_O, "The descriptor of a connection, -1 if there is none."},
    {"hear", hear, METH_O, "Source, number, page and bell of who has connected; BlockingIOError: nothing said yet."},
    {NULL, NULL, 0, NULL},
};

int add_broadcast(PyObject *module) {
    dont_wait = PyLong_FromLong(1);
    no_flags = PyLong_FromLong(0);
    if (dont_wait == NULL || no_flags == NULL || PyModule_AddFunctions(module, functions) < 0) return -1;
    return PyModule_AddType(module, &BroadcastType) < 0 ? -1 : PyModule_AddType(module, &RingReaderType);
}
