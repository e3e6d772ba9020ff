/* Frames from where a message comes, and the ends of a pipe; see `pipe.py`, which does the same in Python. */

#include "_native.h"

#include <errno.h>
#include <poll.h>
#include <string.h>
#include <unistd.h>

enum {
    READ_BYTES = 1 << 16,
    KEPT_BYTES = 1 << 20, /* a buffer that grew beyond this for one frame is let go after it */
    FEW_BYTES = 1 << 12,  /* who reads so few at a time, again and again, keeps up with the writer */
    LOOK_NS = 8000,
};

static PyObject *dont_wait, *no_flags; /* of ZeroMQ, as ints */
static PyObject *reader_take(PyObject *self, int may_wait);
static PyTypeObject PipeReaderType;

PyObject *take_frame(PyObject *receive, PyObject *again, int may_wait) {
    if (PyCFunction_CheckExact(receive)) { /* one of ours needs no exception */
        PyObject *self = PyCFunction_GET_SELF(receive);
        if (self != NULL && Py_IS_TYPE(self, &PipeReaderType)) return reader_take(self, may_wait);
        if (self != NULL && Py_IS_TYPE(self, &SocketType)) return socket_take(self, may_wait);
    }
    PyObject *flags[2] = {NULL, may_wait ? no_flags : dont_wait};
    PyObject *frame = PyObject_Vectorcall(receive, flags + 1, 1 | PY_VECTORCALL_ARGUMENTS_OFFSET, NULL);
    if (frame == NULL && PyErr_ExceptionMatches(again)) PyErr_Clear();
    return frame;
}

typedef struct {
    PyObject_HEAD
    int fd;
    PyObject *again;
    PyObject *left; /* a frame that was written in part, or NULL */
    Py_ssize_t written;
} PipeWriter;

/* Write as much as there is room for; -1: no room at all. A reader that is gone takes everything. */
static Py_ssize_t write_some(int fd, const char *data, Py_ssize_t size) {
    Py_ssize_t written = 0;
    while (written < size) {
        const ssize_t count = write(fd, data + written, (size_t)(size - written));
        if (count >= 0) {
            written += count;
        } else if (errno == EAGAIN || errno == EWOULDBLOCK) {
            return written ? written : -1;
        } else if (errno != EINTR) {
            return size;
        }
    }
    return written;
}

/* Write the rest of a frame; whether all is written. */
static int flush_left(PipeWriter *writer) {
    if (writer->left == NULL) return 1;
    const Py_ssize_t size = PyBytes_GET_SIZE(writer->left);
    const char *data = PyBytes_AS_STRING(writer->left) + writer->written;
    const Py_ssize_t count = write_some(writer->fd, data, size - writer->written);
    if (count > 0) writer->written += count;
    if (writer->written < size) return 0;
    Py_CLEAR(writer->left);
    return 1;
}

/* Write a frame; 0 if there is no room. */
static int write_frame(PipeWriter *writer, PyObject *frame) {
    if (!flush_left(writer)) return 0;
    const Py_ssize_t size = PyBytes_GET_SIZE(frame);
    const Py_ssize_t count = write_some(writer->fd, PyBytes_AS_STRING(frame), size);
    if (count < 0) return 0;
    if (count < size) {
        writer->left = Py_NewRef(frame);
        writer->written = count;
    }
    return 1;
}

PyObject *frame_argument(PyObject *const *arguments, Py_ssize_t count) {
    if (count < 1 || count > 2 || !PyBytes_CheckExact(arguments[0])) {
        PyErr_SetString(PyExc_TypeError, "expected a frame as bytes, and flags");
        return NULL;
    }
    return arguments[0];
}

static PyObject *writer_send(PipeWriter *writer, PyObject *const *arguments, Py_ssize_t count) {
    PyObject *frame = frame_argument(arguments, count);
    if (frame == NULL) return NULL;
    if (write_frame(writer, frame)) Py_RETURN_NONE;
    PyErr_SetNone(writer->again);
    return NULL;
}

static PyObject *writer_offer(PipeWriter *writer, PyObject *const *arguments, Py_ssize_t count) {
    PyObject *frame = frame_argument(arguments, count);
    if (frame == NULL) return NULL;
    write_frame(writer, frame);
    Py_RETURN_NONE;
}

static PyObject *writer_flush(PipeWriter *writer, PyObject *unused) {
    (void)unused;
    return PyBool_FromLong(flush_left(writer));
}

static PyObject *writer_close(PipeWriter *writer, PyObject *unused) {
    (void)unused;
    const int fd = writer->fd;
    writer->fd = -1;
    if (fd >= 0) close(fd);
    Py_RETURN_NONE;
}

static PyObject *writer_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"fd", "again", "left", NULL};
    int fd;
    PyObject *again, *left = NULL;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "iO|S:PipeWriter", names, &fd, &again, &left)) return NULL;
    PipeWriter *writer = (PipeWriter *)type->tp_alloc(type, 0);
    if (writer == NULL) return NULL;
    writer->fd = fd;
    writer->again = Py_NewRef(again);
    writer->left = Py_XNewRef(left);
    return (PyObject *)writer;
}

static void writer_dealloc(PipeWriter *writer) {
    if (writer->fd >= 0) close(writer->fd);
    Py_XDECREF(writer->again);
    Py_XDECREF(writer->left);
    Py_TYPE(writer)->tp_free((PyObject *)writer);
}

static PyObject *writer_detach(PipeWriter *writer, PyObject *unused) {
    (void)unused;
    const Py_ssize_t size = writer->left == NULL ? 0 : PyBytes_GET_SIZE(writer->left) - writer->written;
    const char *data = writer->left == NULL ? "" : PyBytes_AS_STRING(writer->left) + writer->written;
    PyObject *parts = Py_BuildValue("iy#", writer->fd, data, size);
    if (parts == NULL) return NULL;
    writer->fd = -1;
    Py_CLEAR(writer->left);
    return parts;
}

static PyMethodDef writer_methods[] = {
    {"send", (PyCFunction)(void (*)(void))writer_send, METH_FASTCALL, "Write a frame; `again` if there is no room."},
    {"offer", (PyCFunction)(void (*)(void))writer_offer, METH_FASTCALL, "Write a frame if there is room."},
    {"flush", (PyCFunction)writer_flush, METH_NOARGS, "Write the rest of a frame; whether all is written."},
    {"detach", (PyCFunction)writer_detach, METH_NOARGS, "The descriptor, given up, and what is left of a frame."},
    {"close", (PyCFunction)writer_close, METH_NOARGS, "Write no more."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject PipeWriterType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.PipeWriter",
    .tp_doc = "PipeWriter(fd, again, left=b'')\n--\n\n"
              "The publisher's end of a pipe, which owns the descriptor; what is left is written first.",
    .tp_basicsize = sizeof(PipeWriter),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_new = writer_new,
    .tp_dealloc = (destructor)writer_dealloc,
    .tp_methods = writer_methods,
};

typedef struct {
    PyObject_HEAD
    int fd, socket_fd;
    PyObject *receive, *again;
    int wait_ms;
    int broken;
    char *buffer;
    Py_ssize_t begin, end, capacity;
    int64_t read_ns; /* when something was last read */
    int in_rush;
} PipeReader;

/* Size of the frame that begins the buffer; 0: its header is not there yet; -1: it is no frame. */
static Py_ssize_t frame_size(const char *data, Py_ssize_t available) {
    if (available < HEADER_SIZE) return 0;
    if (memcmp(data, "CTX", 3)) return -1;
    if (data[3] == 'S') return SLOT_FRAME_SIZE;
    uint64_t body;
    memcpy(&body, data + 48, 8);
    return (data[3] == 'M' || data[3] == 'B') && body <= (uint64_t)1 << 30 ? HEADER_SIZE + (Py_ssize_t)body : -1;
}

/* Give what has come of a frame another place; 0: no memory. */
static int move_to(PipeReader *reader, Py_ssize_t capacity) {
    const Py_ssize_t held = reader->end - reader->begin;
    char *other = PyMem_Malloc((size_t)capacity);
    if (other == NULL) return 0;
    memcpy(other, reader->buffer + reader->begin, (size_t)held);
    PyMem_Free(reader->buffer);
    reader->buffer = other;
    reader->capacity = capacity;
    reader->begin = 0;
    reader->end = held;
    return 1;
}

/* Make room for a read behind what has come of a frame of `size` bytes; 0: no memory.

   Memory grows with what has come, not with what a header says will come. */
static int make_room(PipeReader *reader, Py_ssize_t size) {
    const Py_ssize_t held = reader->end - reader->begin;
    if (!held && reader->capacity > KEPT_BYTES) return move_to(reader, 2 * READ_BYTES);
    if (reader->capacity - reader->end >= READ_BYTES) return 1;
    if (reader->capacity - held < READ_BYTES) {
        const Py_ssize_t most = (size > held ? size : held) + READ_BYTES;
        return move_to(reader, most < 2 * reader->capacity ? most : 2 * reader->capacity);
    }
    memmove(reader->buffer, reader->buffer + reader->begin, (size_t)held);
    reader->begin = 0;
    reader->end = held;
    return 1;
}

/* Read from the pipe as `read` does. In a rush, a reader that keeps up would look again after each message or two, and
   hold up the writer each time, who is slowed by a third: so it leaves some time between looks, too short to sleep. */
static ssize_t read_some(PipeReader *reader) {
    while (reader->in_rush && monotonic_ns() - reader->read_ns < LOOK_NS) continue;
    ssize_t count;
    do count = read(reader->fd, reader->buffer + reader->end, READ_BYTES);
    while (count < 0 && errno == EINTR);
    if (count <= 0) return count;
    const int64_t now_ns = monotonic_ns();
    reader->in_rush = count < FEW_BYTES && now_ns - reader->read_ns < 4 * LOOK_NS;
    reader->read_ns = now_ns;
    return count;
}

/* The next frame of the pipe where it lies, until the next call; NULL if there is none, perhaps with an error. */
static const char *peek_frame(PipeReader *reader, Py_ssize_t *size) {
    while (!reader->broken) {
        const Py_ssize_t held = reader->end - reader->begin;
        *size = frame_size(reader->buffer + reader->begin, held);
        if (*size < 0) {
            *size = held;
            reader->broken = 1;
        }
        if (reader->broken || (*size > 0 && *size <= held)) {
            reader->begin += *size;
            return reader->buffer + reader->begin - *size;
        }
        if (!make_room(reader, *size)) {
            PyErr_NoMemory();
            return NULL;
        }
        const ssize_t count = read_some(reader);
        if (count <= 0) return NULL;
        reader->end += count;
    }
    return NULL;
}

/* The next frame of the pipe as bytes; NULL if there is none, perhaps with an error. */
static PyObject *next_frame(PipeReader *reader) {
    Py_ssize_t size;
    const char *data = peek_frame(reader, &size);
    return data == NULL ? NULL : PyBytes_FromStringAndSize(data, size);
}

/* The next frame, from the pipe or else from the socket; NULL if there is none, perhaps with an error. */
static PyObject *reader_take(PyObject *self, int may_wait) {
    PipeReader *reader = (PipeReader *)self;
    PyObject *frame = next_frame(reader);
    if (frame != NULL || PyErr_Occurred()) return frame;
    frame = take_frame(reader->receive, reader->again, 0); /* after this its descriptor shows what comes */
    if (frame != NULL || PyErr_Occurred() || !may_wait) return frame;
    struct pollfd sources[2] = {{reader->fd, POLLIN, 0}, {reader->socket_fd, POLLIN, 0}};
    Py_BEGIN_ALLOW_THREADS
    poll(sources, 2, reader->wait_ms);
    Py_END_ALLOW_THREADS
    if (PyErr_CheckSignals() < 0) return NULL;
    frame = next_frame(reader);
    if (frame != NULL || PyErr_Occurred()) return frame;
    return take_frame(reader->receive, reader->again, 0);
}

static PyObject *reader_receive(PipeReader *reader, PyObject *flags) {
    const long wanted = PyLong_AsLong(flags);
    if (wanted == -1 && PyErr_Occurred()) return NULL;
    PyObject *frame = reader_take((PyObject *)reader, !(wanted & 1));
    if (frame == NULL && !PyErr_Occurred()) PyErr_SetNone(reader->again);
    return frame;
}

static PyObject *reader_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"fd", "socket_fd", "receive", "again", "wait_ms", NULL};
    int fd, socket_fd, wait_ms;
    PyObject *receive, *again;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "iiOOi:PipeReader", names, &fd, &socket_fd, &receive, &again,
                                     &wait_ms))
        return NULL;
    PipeReader *reader = (PipeReader *)type->tp_alloc(type, 0);
    if (reader == NULL) return NULL;
    reader->fd = fd;
    reader->socket_fd = socket_fd;
    reader->wait_ms = wait_ms;
    reader->receive = Py_NewRef(receive);
    reader->again = Py_NewRef(again);
    reader->buffer = PyMem_Malloc(2 * READ_BYTES);
    if (reader->buffer == NULL) {
        Py_DECREF(reader);
        return PyErr_NoMemory();
    }
    reader->capacity = 2 * READ_BYTES;
    return (PyObject *)reader;
}

static int reader_traverse(PipeReader *reader, visitproc visit, void *arg) {
    Py_VISIT(reader->receive);
    Py_VISIT(reader->again);
    return 0;
}

static int reader_clear(PipeReader *reader) {
    Py_CLEAR(reader->receive);
    Py_CLEAR(reader->again);
    return 0;
}

static void reader_dealloc(PipeReader *reader) {
    PyObject_GC_UnTrack(reader);
    reader_clear(reader);
    PyMem_Free(reader->buffer);
    Py_TYPE(reader)->tp_free((PyObject *)reader);
}

static PyObject *reader_broken(PipeReader *reader, void *unused) {
    (void)unused;
    return PyBool_FromLong(reader->broken);
}

static PyGetSetDef reader_properties[] = {
    {"broken", (getter)reader_broken, NULL, "Whether it brought something that is no frame.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyMethodDef reader_methods[] = {
    {"receive", (PyCFunction)reader_receive, METH_O, "Take the next frame; `again` if there is none."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject PipeReaderType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.PipeReader",
    .tp_doc = "PipeReader(fd, socket_fd, receive, again, wait_ms)\n--\n\nThe subscriber's end of a pipe.",
    .tp_basicsize = sizeof(PipeReader),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .tp_new = reader_new,
    .tp_traverse = (traverseproc)reader_traverse,
    .tp_clear = (inquiry)reader_clear,
    .tp_dealloc = (destructor)reader_dealloc,
    .tp_methods = reader_methods,
    .tp_getset = reader_properties,
};

int add_pipe(PyObject *module) {
    dont_wait = PyLong_FromLong(1);
    no_flags = PyLong_FromLong(0);
    if (dont_wait == NULL || no_flags == NULL) return -1;
    return PyModule_AddType(module, &PipeWriterType) < 0 ? -1 : PyModule_AddType(module, &PipeReaderType);
}
