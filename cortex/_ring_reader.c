/* A subscriber's end of a publisher's ring, for Python; what it does is in `broadcast.h`, which C++ uses, too. */

#include "_broadcast.h"

#include "_numpy.h"
#include "cpp/include/cortex/broadcast.h"

#include <poll.h>
#include <structmember.h>

static PyObject *dont_wait, *no_flags; /* of ZeroMQ, as ints */

static PyTypeObject RingReaderType;

typedef struct {
    PyObject_HEAD
    CortexReader ring;
    PyObject *receive, *again;
    PyObject *body; /* of the frame that was taken last, if it names a slot; else NULL */
    int socket_fd, wait_ms;
    int open, told;  /* that nothing more comes */
    int is_crowded;  /* the next message finds no memory until others are let go */
} RingReader;

/* What keeps the body of one message: the lease of its slot, or a copy. */
typedef struct {
    PyObject_HEAD
    CortexBody body;
} Body;

static void body_dealloc(Body *body) {
    cortex_body_end(&body->body);
    Py_TYPE(body)->tp_free((PyObject *)body);
}

static PyTypeObject BodyType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Body",
    .tp_doc = "The base of all arrays that look at one large message; gives its slot back when it dies.",
    .tp_basicsize = sizeof(Body),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .tp_dealloc = (destructor)body_dealloc,
};

/* Keep a body in `reader->body`; 0 with an error set. */
static int keep_body(RingReader *reader, CortexBody *found) {
    Body *body = (Body *)BodyType.tp_alloc(&BodyType, 0);
    if (body == NULL) {
        cortex_body_end(found);
        return 0;
    }
    body->body = *found;
    reader->body = (PyObject *)body;
    return 1;
}

/* The next frame as bytes; NULL if there is none, perhaps with an error. Then the wakeup is signalled when one comes. */
static PyObject *next_frame(RingReader *reader) {
    const uint8_t *data;
    int64_t size;
    Py_CLEAR(reader->body);
    reader->is_crowded = 0;
    if (!reader->open || reader->ring.ring == NULL) return NULL;
    while ((size = cortex_reader_peek(&reader->ring, &data)) > 0) {
        PyObject *frame = PyBytes_FromStringAndSize((const char *)data, (Py_ssize_t)size);
        if (frame == NULL) return NULL;
        CortexBody body;
        const int found = cortex_reader_finish(&reader->ring, (const uint8_t *)PyBytes_AS_STRING(frame), size, &body);
        const int kept = body.data == NULL || keep_body(reader, &body);
        reader->is_crowded = found < 0;
        if (found > 0 && kept) {
            cortex_reader_disarm(&reader->ring);
            return frame;
        }
        Py_DECREF(frame);
        if (found < 0 || !kept) return NULL;
    }
    if (size == 0 || reader->told) return NULL;
    reader->told = 1;
    return PyBytes_FromStringAndSize(NULL, 0); /* no frame: the link sees why */
}

PyObject *reader_body(PyObject *object, const char **data, Py_ssize_t *size) {
    if (object == NULL || !Py_IS_TYPE(object, &RingReaderType)) return NULL;
    RingReader *reader = (RingReader *)object;
    if (reader->body == NULL) return NULL;
    *data = (const char *)((Body *)reader->body)->body.data;
    *size = (Py_ssize_t)((Body *)reader->body)->body.size;
    return reader->body;
}

void reader_body_taken(PyObject *reader) { Py_CLEAR(((RingReader *)reader)->body); }

static PyObject *reader_take_body(RingReader *reader, PyObject *unused) {
    (void)unused;
    PyObject *body = reader->body;
    reader->body = NULL;
    if (body == NULL) Py_RETURN_NONE;
    npy_intp shape = (npy_intp)((Body *)body)->body.size;
    PyObject *array = PyArray_New(&PyArray_Type, 1, &shape, NPY_UINT8, NULL, ((Body *)body)->body.data, 0, 0, NULL);
    if (array == NULL) {
        Py_DECREF(body);
        return NULL;
    }
    PyArray_CLEARFLAGS((PyArrayObject *)array, NPY_ARRAY_WRITEABLE);
    PyArray_UpdateFlags((PyArrayObject *)array, NPY_ARRAY_ALIGNED | NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_F_CONTIGUOUS);
    if (PyArray_SetBaseObject((PyArrayObject *)array, body) == 0) return array; /* takes the body in any case */
    Py_DECREF(array);
    return NULL;
}

/* As `next_frame`, with the wakeup armed if there is none. */
static PyObject *next_or_arm(RingReader *reader) {
    while (1) {
        PyObject *frame = next_frame(reader);
        if (frame != NULL || PyErr_Occurred() || !reader->open || reader->ring.ring == NULL || reader->ring.state != CORTEX_SOUND || reader->is_crowded
            || cortex_reader_arm(&reader->ring))
            return frame;
    }
}

/* Wait for the wakeup or the socket, without the GIL; 0 with an error set. */
static int reader_wait(RingReader *reader) {
    struct pollfd sources[2] = {{reader->ring.wakeup, POLLIN, 0}, {reader->socket_fd, POLLIN, 0}};
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
    Py_CLEAR(reader->body);
    if (reader->open) cortex_reader_close(&reader->ring);
    reader->open = 0;
    Py_RETURN_NONE;
}

static PyObject *reader_welcomed(RingReader *reader, PyObject *unused) {
    (void)unused;
    const int found = reader->open ? cortex_reader_welcomed(&reader->ring) : 0;
    if (found == 0) Py_RETURN_NONE;
    if (found < 0) return PyErr_SetFromErrno(PyExc_OSError);
    return PyLong_FromUnsignedLongLong(reader->ring.first);
}

static PyObject *reader_pass_over(RingReader *reader, PyObject *unused) {
    (void)unused;
    if (reader->is_crowded) cortex_reader_pass_over(&reader->ring);
    reader->is_crowded = 0;
    Py_RETURN_NONE;
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
    Py_XDECREF(reader->body);
    if (reader->open) cortex_reader_close(&reader->ring);
    Py_TYPE(reader)->tp_free((PyObject *)reader);
}

static PyObject *reader_broken(RingReader *reader, void *unused) {
    (void)unused;
    return PyBool_FromLong(reader->ring.state == CORTEX_BROKEN);
}

static PyObject *reader_ended(RingReader *reader, void *unused) {
    (void)unused;
    return PyBool_FromLong(reader->ring.state == CORTEX_ENDED);
}

static PyGetSetDef reader_properties[] = {
    {"broken", (getter)reader_broken, NULL, "Whether there is something in the ring that is no frame.", NULL},
    {"ended", (getter)reader_ended, NULL, "Whether all that follows comes another way.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyMemberDef reader_members[] = {
    {"fd", T_INT, offsetof(RingReader, ring.wakeup), READONLY, "Becomes readable when a frame comes after none was there."},
    {"is_crowded", T_INT, offsetof(RingReader, is_crowded), READONLY, "Whether the next message waits, as too many large ones are kept."},
    {NULL, 0, 0, 0, NULL},
};

static PyMethodDef reader_methods[] = {
    {"receive", (PyCFunction)reader_receive, METH_O, "Take the next frame; `again` if there is none."},
    {"take_body", (PyCFunction)reader_take_body, METH_NOARGS,
     "The body of the frame that was taken last, read-only, shape [size]; None if it named no slot with a message."},
    {"pass_over", (PyCFunction)reader_pass_over, METH_NOARGS, "Leave out the message that waits as too many are kept."},
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
    .tp_members = reader_members,
    .tp_getset = reader_properties,
};

int may_look_unlocked(PyObject *receive, int may_wait, uint64_t expected) {
    RingReader *reader = PyCFunction_CheckExact(receive) ? (RingReader *)PyCFunction_GET_SELF(receive) : NULL;
    if (reader == NULL || !Py_IS_TYPE(reader, &RingReaderType) || !reader->open || reader->ring.ring == NULL) return 0;
    const uint8_t *frame;
    uint64_t sequence;
    const int64_t size = cortex_reader_peek(&reader->ring, &frame);
    if (size == 0) {
        PyObject *socket = PyCFunction_CheckExact(reader->receive) ? PyCFunction_GET_SELF(reader->receive) : NULL;
        return !may_wait && socket != NULL && Py_IS_TYPE(socket, &SocketType);
    }
    if (size < HEADER_SIZE) return 0;
    memcpy(&sequence, frame + HEAD_SIZE, sizeof sequence);
    return sequence == expected;
}

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

int add_ring_reader(PyObject *module) {
    dont_wait = PyLong_FromLong(1);
    no_flags = PyLong_FromLong(0);
    if (dont_wait == NULL || no_flags == NULL || PyType_Ready(&BodyType) < 0) return -1;
    return PyModule_AddType(module, &RingReaderType);
}
