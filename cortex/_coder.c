/* A `Coder` is made once per message type and publisher. It writes a message as a frame or as a bare body,
   and reads them back: what `body.py` does, in a tenth of the time.

   It is strict: of whatever is not exactly as usual (another class, a number of NumPy, a wrong dtype or shape, a
   malformed body) it returns None, and the Python code does the work, or says what is wrong. So it never raises for a
   message's content, and both ways give the same bytes.

   The layout is that of WIRE.md, section 5.1; all numbers are little-endian, as is every machine we build for. */

#include "_coder.h"
#include "_broadcast.h"

#include <string.h>
#include <structmember.h>

#if PY_BIG_ENDIAN
#error "only little-endian machines"
#endif


/* Writing */

int write_frame(const Coder *coder, PyObject *message, char *out, Py_ssize_t size, uint64_t sequence, int64_t publish_ns) {
    Pack pack;
    if (!write_body(coder, message, &pack, out + HEADER_SIZE, size, 0)) return 0;
    memcpy(out, coder->head, HEAD_SIZE);
    const uint64_t rest[5] = {sequence, (uint64_t)pack.stamp_ns, (uint64_t)publish_ns, (uint64_t)size, 0};
    memcpy(out + HEAD_SIZE, rest, sizeof rest);
    return 1;
}

PyObject *make_frame(const Coder *coder, PyObject *message, Py_ssize_t size, uint64_t sequence, int64_t publish_ns) {
    PyObject *frame = PyBytes_FromStringAndSize(NULL, HEADER_SIZE + size);
    if (frame == NULL || write_frame(coder, message, PyBytes_AS_STRING(frame), size, sequence, publish_ns)) return frame;
    Py_DECREF(frame);
    return NULL;
}

PyDoc_STRVAR(encode_doc,
"encode($self, message, limit, /)\n--\n\n"
"The body of a message; None if the message is not as usual, or its body has more than `limit` bytes.");

static PyObject *coder_encode(Coder *coder, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 2)) return NULL;
    const Py_ssize_t limit = PyLong_AsSsize_t(arguments[1]);
    if (limit == -1 && PyErr_Occurred()) return NULL;
    const Py_ssize_t size = measure_body(coder, arguments[0]);
    if (size < 0 || size > limit) Py_RETURN_NONE;
    PyObject *body = PyBytes_FromStringAndSize(NULL, size);
    if (body == NULL) return NULL;
    Pack pack;
    return write_body(coder, arguments[0], &pack, PyBytes_AS_STRING(body), size, 0) ? body : none_or_error(body);
}

/* Reading */

/* The message in the slot that a descriptor names; NULL without error if it is not as usual. */
static PyObject *read_slot(const Coder *coder, PyObject *frame, uint64_t *sequence, int64_t *publish_ns) {
    const char *bytes = PyBytes_AS_STRING(frame), *body;
    if (PyBytes_GET_SIZE(frame) != HEADER_SIZE || memcmp(bytes, coder->head, 3)
        || memcmp(bytes + 4, coder->head + 4, HEAD_SIZE - 4))
        return NULL;
    Py_ssize_t size;
    PyObject *owner = reader_body(coder->slots, &body, &size);
    if (owner == NULL) return NULL;
    PyObject *message = read_body(coder, owner, body, size);
    if (message == NULL) return NULL;
    reader_body_taken(coder->slots);
    memcpy(sequence, bytes + HEAD_SIZE, 8);
    memcpy(publish_ns, bytes + HEAD_SIZE + 16, 8);
    return message;
}

/* What a plain frame of this publisher says; NULL without error if it is none. */
static PyObject *read_frame(const Coder *coder, PyObject *frame, uint64_t *sequence, int64_t *publish_ns) {
    if (!coder->has_head || !PyBytes_CheckExact(frame) || PyBytes_GET_SIZE(frame) < HEADER_SIZE) return NULL;
    const char *bytes = PyBytes_AS_STRING(frame);
    if (bytes[3] == 'S' && coder->slots != NULL) return read_slot(coder, frame, sequence, publish_ns);
    if (memcmp(bytes, coder->head, HEAD_SIZE)) return NULL;
    uint64_t rest[5];
    memcpy(rest, bytes + HEAD_SIZE, sizeof rest);
    const Py_ssize_t size = PyBytes_GET_SIZE(frame) - HEADER_SIZE;
    if (rest[3] != (uint64_t)size) return NULL;
    *sequence = rest[0];
    *publish_ns = (int64_t)rest[2];
    return read_body(coder, frame, bytes + HEADER_SIZE, size);
}

int note_latency(PyObject *latency, int64_t elapsed_ns) {
    Py_ssize_t bucket = 0;
    for (uint64_t left = elapsed_ns > 0 ? (uint64_t)elapsed_ns : 0; left; left >>= 1) ++bucket;
    const Py_ssize_t last = PyList_GET_SIZE(latency) - 1;
    if (bucket > last) bucket = last;
    const long long count = PyLong_AsLongLong(PyList_GET_ITEM(latency, bucket));
    if (count == -1 && PyErr_Occurred()) return 0;
    PyObject *more = PyLong_FromLongLong(count + 1);
    return more != NULL && PyList_SetItem(latency, bucket, more) == 0;
}

PyObject *read_expected(const Coder *coder, PyObject *frame, uint64_t expected, int64_t *publish_ns) {
    uint64_t sequence;
    if (coder->has_head && PyBytes_CheckExact(frame) && PyBytes_GET_SIZE(frame) >= HEADER_SIZE) {
        memcpy(&sequence, PyBytes_AS_STRING(frame) + HEAD_SIZE, 8);
        if (sequence != expected) return NULL;
    }
    return read_frame(coder, frame, &sequence, publish_ns);
}

PyDoc_STRVAR(decode_doc,
"decode($self, buffer, offset, size, /)\n--\n\n"
"The message of `size` bytes of a bytes object, or of an array of bytes, from an offset on; None if they are not as\n"
"usual. Arrays of the message are read-only views that keep the buffer.");

static int is_bytes_array(PyObject *buffer) {
    if (!PyArray_Check(buffer)) return 0;
    PyArrayObject *array = (PyArrayObject *)buffer;
    return PyArray_NDIM(array) == 1 && PyArray_TYPE(array) == NPY_UINT8 && PyArray_IS_C_CONTIGUOUS(array)
        && !PyArray_ISWRITEABLE(array);
}

static PyObject *coder_decode(Coder *coder, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 3)) return NULL;
    PyObject *buffer = arguments[0];
    const Py_ssize_t offset = PyLong_AsSsize_t(arguments[1]), size = PyLong_AsSsize_t(arguments[2]);
    if (PyErr_Occurred()) return NULL;
    const char *bytes;
    Py_ssize_t available;
    if (PyBytes_CheckExact(buffer)) {
        bytes = PyBytes_AS_STRING(buffer);
        available = PyBytes_GET_SIZE(buffer);
    } else if (is_bytes_array(buffer)) {
        bytes = PyArray_BYTES((PyArrayObject *)buffer);
        available = PyArray_NBYTES((PyArrayObject *)buffer);
    } else {
        Py_RETURN_NONE;
    }
    if (offset < 0 || size < 0 || offset > available || size > available - offset) Py_RETURN_NONE;
    PyObject *message = read_body(coder, buffer, bytes + offset, size);
    return message == NULL ? none_or_error(NULL) : message;
}

/* The type */

static PyObject *coder_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"rows", "objects", "stamp", "head", NULL};
    PyObject *rows, *objects, *head;
    Py_ssize_t stamp;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "SO!nS:Coder", names, &rows, &PyTuple_Type, &objects, &stamp, &head))
        return NULL;
    if (PyBytes_GET_SIZE(rows) == 0 || PyBytes_GET_SIZE(rows) % (Py_ssize_t)sizeof(CortexItem)) {
        PyErr_Format(PyExc_ValueError, "a row has %zu bytes, got %zd", sizeof(CortexItem), PyBytes_GET_SIZE(rows));
        return NULL;
    }
    const Py_ssize_t head_size = PyBytes_GET_SIZE(head);
    if (head_size != 0 && head_size != HEAD_SIZE) {
        PyErr_Format(PyExc_ValueError, "a head has %d bytes, got %zd", HEAD_SIZE, head_size);
        return NULL;
    }
    Coder *coder = (Coder *)type->tp_alloc(type, 0);
    if (coder == NULL) return NULL;
    memcpy(coder->head, PyBytes_AS_STRING(head), (size_t)head_size);
    coder->has_head = head_size != 0;
    coder->stamp = stamp;
    coder->rows = Py_NewRef(rows);
    coder->objects = Py_NewRef(objects);
    coder->items = (const CortexItem *)(const void *)PyBytes_AS_STRING(rows);
    return (PyObject *)coder;
}

static int coder_traverse(Coder *coder, visitproc visit, void *arg) {
    Py_VISIT(coder->slots);
    Py_VISIT(coder->objects);
    return 0;
}

/* What keeps the table in a cycle is its class, which breaks it. */
static int coder_clear(Coder *coder) {
    Py_CLEAR(coder->slots);
    return 0;
}

static void coder_dealloc(Coder *coder) {
    PyObject_GC_UnTrack(coder);
    coder_clear(coder);
    Py_XDECREF(coder->rows);
    Py_XDECREF(coder->objects);
    Py_TYPE(coder)->tp_free((PyObject *)coder);
}

static PyMethodDef coder_methods[] = {
    {"encode", (PyCFunction)(void (*)(void))coder_encode, METH_FASTCALL, encode_doc},
    {"decode", (PyCFunction)(void (*)(void))coder_decode, METH_FASTCALL, decode_doc},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef coder_members[] = {
    {"slots", T_OBJECT, offsetof(Coder, slots), 0, "A `RingReader`, which has the bodies that are in slots; None: they are not read."},
    {NULL, 0, 0, 0, NULL},
};

PyDoc_STRVAR(coder_doc,
"Coder(rows, objects, stamp, head)\n--\n\n"
"Writes and reads the messages of one type.\n\n"
"Args:\n"
"    rows: The table that `native.py` makes of the type: what it says is not checked.\n"
"    objects: What the rows name.\n"
"    stamp: Number of the row of the field that is the stamp, -1: none.\n"
"    head: What frames begin with, 24 bytes; empty: this one makes and reads no frames.\n");

PyTypeObject CoderType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Coder",
    .tp_doc = coder_doc,
    .tp_basicsize = sizeof(Coder),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .tp_new = coder_new,
    .tp_traverse = (traverseproc)coder_traverse,
    .tp_clear = (inquiry)coder_clear,
    .tp_dealloc = (destructor)coder_dealloc,
    .tp_methods = coder_methods,
    .tp_members = coder_members,
};

int add_coder(PyObject *module) { return PyModule_AddType(module, &CoderType); }
