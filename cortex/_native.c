/* The way of a message, in C: what `fast.py`, `gate.py` and `drain` of `packer.py` do, in a fifth of the time.
   A large one is written into and read from a slot of shared memory, whose account `_ring.c` keeps.

   A `Flat` is made once per message type and publisher. It writes a message as a frame, as a record of a batch or as a bare body,
   and reads a frame or a body back. It is strict: of whatever is not exactly as usual (another class, an integer
   that is no `int`, a wrong dtype or shape, a malformed body) it returns None, and the Python code does the work,
   or says what is wrong. So it never raises for a message's content, and both ways give the same bytes.

   The layout is that of WIRE.md, section 5.1; all numbers are little-endian, as is every machine we build for. */

#include "_native.h"
#include "_ring.h"

#include <errno.h>
#include <poll.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#include <structmember.h>

#define PY_ARRAY_UNIQUE_SYMBOL cortex_numpy
#define NPY_NO_DEPRECATED_API NPY_1_19_API_VERSION
#define NPY_TARGET_VERSION NPY_1_19_API_VERSION
#include <numpy/arrayobject.h>

#if PY_BIG_ENDIAN
#error "only little-endian machines"
#endif

enum {
    RANK_MAX = 8,
    DIMENSIONS_MAX = 16,
    FIELDS_MAX = 64,
    LARGE_ARRAY_BYTES = 1024,
    HEADER_SIZE = 64,
    HEAD_SIZE = 24,
    RECORD_SIZE = 24,
    SLOT_FRAME_SIZE = HEADER_SIZE + 8 + 32,
    READ_BYTES = 1 << 16,
    GATHER_MAX = 256,
    DEFERRED_BYTES = 1 << 14,
    UNLOCKED_BYTES = 1 << 17, /* to copy so many takes longer than to let others have the lock meanwhile */
};
static const Py_ssize_t BODY_LIMIT = (Py_ssize_t)1 << 32;

typedef enum { NUMBER, BOOL, FIXED, VARIABLE, STR, BYTES } Kind;

typedef struct {
    Kind kind;
    char code;           /* NUMBER: that of the struct module */
    Py_ssize_t slot;     /* where the message object keeps the value */
    Py_ssize_t offset;   /* where the block has it */
    PyArray_Descr *dtype; /* arrays */
    Py_ssize_t itemsize;
    int rank;
    npy_intp shape[RANK_MAX]; /* -1: any size */
    int names[RANK_MAX];      /* number of the named dimension that must agree, -1: none */
    uint32_t head;            /* VARIABLE: second number of the descriptor */
    Py_ssize_t bytes;         /* FIXED */
} Field;

typedef struct {
    PyObject_HEAD
    PyTypeObject *cls;
    Py_ssize_t count;
    Py_ssize_t block;
    Py_ssize_t stamp; /* field that is the stamp, -1: none */
    int dimension_count;
    int has_tail; /* bodies differ in size */
    int has_head;
    char head[HEAD_SIZE];
    PyObject *slots; /* a SlotView whose messages are read here, too; NULL or None: none */
    Field *fields;
} Flat;

/* One message on its way to bytes. */
typedef struct {
    const char *data[FIELDS_MAX]; /* of values outside of the block */
    Py_ssize_t start[FIELDS_MAX]; /* where they come in the body */
    Py_ssize_t size[FIELDS_MAX];
    int64_t stamp_ns;
    Py_ssize_t end;
    int defers; /* whether `write_body` leaves large arrays to `copy_arrays` */
} Layout;

static inline PyObject **place_of(const Field *field, PyObject *message) {
    return (PyObject **)((char *)message + field->slot);
}

static inline Py_ssize_t align_to(Py_ssize_t position, Py_ssize_t alignment) {
    return (position + alignment - 1) & -alignment;
}

/* Write a number; 0 if it is not of the usual class or out of range, with no error set. */
static int write_integer(char code, PyObject *value, char *out) {
    if (!PyLong_CheckExact(value)) return 0;
    if (code == 'Q') {
        uint64_t number = PyLong_AsUnsignedLongLong(value);
        if (number == (uint64_t)-1 && PyErr_Occurred()) {
            PyErr_Clear();
            return 0;
        }
        memcpy(out, &number, 8);
        return 1;
    }
    int overflow;
    const int64_t number = PyLong_AsLongLongAndOverflow(value, &overflow);
    if (overflow) return 0;
#define INTEGER(CODE, TYPE, LOW, HIGH) \
    case CODE: { \
        if (number < (LOW) || number > (HIGH)) return 0; \
        const TYPE narrow = (TYPE)number; \
        memcpy(out, &narrow, sizeof narrow); \
        return 1; \
    }
    switch (code) {
        INTEGER('b', int8_t, INT8_MIN, INT8_MAX)
        INTEGER('h', int16_t, INT16_MIN, INT16_MAX)
        INTEGER('i', int32_t, INT32_MIN, INT32_MAX)
        INTEGER('q', int64_t, INT64_MIN, INT64_MAX)
        INTEGER('B', uint8_t, 0, UINT8_MAX)
        INTEGER('H', uint16_t, 0, UINT16_MAX)
        INTEGER('I', uint32_t, 0, UINT32_MAX)
    }
#undef INTEGER
    return 0;
}

static int write_number(char code, PyObject *value, char *out) {
    if (code != 'd' && code != 'f') return write_integer(code, value, out);
    if (!PyFloat_CheckExact(value)) return 0;
    const double number = PyFloat_AS_DOUBLE(value);
    if (code == 'd') {
        memcpy(out, &number, 8);
        return 1;
    }
    const float narrow = (float)number;
    if (narrow - narrow != 0.0f && number - number == 0.0) return 0; /* too large for a float32 */
    memcpy(out, &narrow, 4);
    return 1;
}

static PyObject *read_number(char code, const char *in) {
#define NUMBER_OF(CODE, TYPE, MAKE) \
    case CODE: { \
        TYPE number; \
        memcpy(&number, in, sizeof number); \
        return MAKE(number); \
    }
    switch (code) {
        NUMBER_OF('b', int8_t, PyLong_FromLong)
        NUMBER_OF('h', int16_t, PyLong_FromLong)
        NUMBER_OF('i', int32_t, PyLong_FromLong)
        NUMBER_OF('q', int64_t, PyLong_FromLongLong)
        NUMBER_OF('B', uint8_t, PyLong_FromLong)
        NUMBER_OF('H', uint16_t, PyLong_FromLong)
        NUMBER_OF('I', uint32_t, PyLong_FromUnsignedLong)
        NUMBER_OF('Q', uint64_t, PyLong_FromUnsignedLongLong)
        NUMBER_OF('f', float, PyFloat_FromDouble)
        NUMBER_OF('d', double, PyFloat_FromDouble)
    }
#undef NUMBER_OF
    Py_UNREACHABLE();
}

/* The array of a field if it is an ordinary one of the right dtype and shape, else NULL. */
static PyArrayObject *array_of(const Field *field, PyObject *value, npy_intp *dimensions) {
    if (!PyArray_CheckExact(value)) return NULL;
    PyArrayObject *array = (PyArrayObject *)value;
    if (PyArray_DESCR(array) != field->dtype || PyArray_NDIM(array) != field->rank) return NULL;
    if (!PyArray_IS_C_CONTIGUOUS(array)) return NULL;
    const npy_intp *shape = PyArray_DIMS(array);
    for (int axis = 0; axis < field->rank; ++axis) {
        if (field->shape[axis] >= 0 && field->shape[axis] != shape[axis]) return NULL;
        if (shape[axis] > UINT32_MAX) return NULL;
        const int name = field->names[axis];
        if (name < 0) continue;
        if (dimensions[name] >= 0 && dimensions[name] != shape[axis]) return NULL;
        dimensions[name] = shape[axis];
    }
    return array;
}

/* First pass: where everything goes; 0 if the message is not as usual. */
static int lay_out(const Flat *flat, PyObject *message, Layout *layout) {
    if (Py_TYPE(message) != flat->cls) return 0;
    npy_intp dimensions[DIMENSIONS_MAX];
    for (int name = 0; name < flat->dimension_count; ++name) dimensions[name] = -1;
    Py_ssize_t end = flat->block;
    for (Py_ssize_t index = 0; index < flat->count; ++index) {
        const Field *field = &flat->fields[index];
        if (field->kind <= BOOL) continue;
        PyObject *value = *place_of(field, message);
        if (value == NULL) return 0;
        Py_ssize_t size;
        const char *data;
        if (field->kind == STR) {
            if (!PyUnicode_CheckExact(value)) return 0;
            data = PyUnicode_AsUTF8AndSize(value, &size);
            if (data == NULL) {
                PyErr_Clear();
                return 0;
            }
        } else if (field->kind == BYTES) {
            if (!PyBytes_CheckExact(value)) return 0;
            data = PyBytes_AS_STRING(value);
            size = PyBytes_GET_SIZE(value);
        } else {
            PyArrayObject *array = array_of(field, value, dimensions);
            if (array == NULL) return 0;
            data = PyArray_BYTES(array);
            size = PyArray_NBYTES(array);
        }
        layout->data[index] = data;
        layout->size[index] = size;
        if (field->kind == FIXED) continue;
        const int is_large = field->kind == VARIABLE && size >= LARGE_ARRAY_BYTES;
        const Py_ssize_t start = align_to(end, is_large ? 64 : 8);
        layout->start[index] = size ? start : 0;
        if (size) end = start + size;
        if (end >= BODY_LIMIT) return 0;
    }
    layout->end = end;
    return 1;
}

static int is_deferred(const Layout *layout, const Field *field, Py_ssize_t index) {
    return layout->defers && layout->size[index] >= DEFERRED_BYTES && (field->kind == FIXED || field->kind == VARIABLE);
}

/* Third pass, where arrays were deferred: it needs no thread state, but someone who keeps the arrays. */
static void copy_arrays(const Flat *flat, const Layout *layout, char *out) {
    for (Py_ssize_t index = 0; index < flat->count; ++index) {
        const Field *field = &flat->fields[index];
        if (field->kind <= BOOL || !is_deferred(layout, field, index)) continue;
        const Py_ssize_t start = field->kind == FIXED ? field->offset : layout->start[index];
        memcpy(out + start, layout->data[index], (size_t)layout->size[index]);
    }
}

/* Hold on to the deferred arrays of a message (`hold` 1), or let them go (-1). */
static void hold_arrays(const Flat *flat, const Layout *layout, PyObject **arrays, int hold) {
    for (Py_ssize_t index = 0; index < flat->count; ++index) {
        if (flat->fields[index].kind <= BOOL || !is_deferred(layout, &flat->fields[index], index)) continue;
        if (hold < 0) Py_DECREF(arrays[index]);
        else Py_INCREF(arrays[index]);
    }
}

/* Second pass: the body; `out` has room for `layout->end` bytes. */
static int write_body(const Flat *flat, PyObject *message, Layout *layout, char *out) {
    memset(out, 0, (size_t)flat->block);
    Py_ssize_t end = flat->block;
    for (Py_ssize_t index = 0; index < flat->count; ++index) {
        const Field *field = &flat->fields[index];
        char *place = out + field->offset;
        PyObject *value = *place_of(field, message);
        switch (field->kind) {
            case NUMBER:
                if (value == NULL || !write_number(field->code, value, place)) return 0;
                continue;
            case BOOL:
                if (value != Py_True && value != Py_False) return 0;
                *place = value == Py_True;
                continue;
            case FIXED:
                if (!is_deferred(layout, field, index)) memcpy(place, layout->data[index], (size_t)layout->size[index]);
                continue;
            default:
                break;
        }
        const Py_ssize_t size = layout->size[index], start = layout->start[index];
        uint32_t numbers[2 + RANK_MAX] = {(uint32_t)start, (uint32_t)size};
        size_t count = 2;
        if (field->kind == VARIABLE) {
            numbers[1] = field->head;
            const npy_intp *shape = PyArray_DIMS((PyArrayObject *)value);
            for (int axis = 0; axis < field->rank; ++axis) numbers[count++] = (uint32_t)shape[axis];
        }
        memcpy(place, numbers, 4 * count);
        if (size) {
            memset(out + end, 0, (size_t)(start - end));
            if (!is_deferred(layout, field, index)) memcpy(out + start, layout->data[index], (size_t)size);
            end = start + size;
        }
    }
    if (flat->stamp >= 0) {
        const Field *field = &flat->fields[flat->stamp];
        PyObject *value = *place_of(field, message);
        layout->stamp_ns = PyLong_AsLongLong(value); /* it is an exact int: it was written */
        if (layout->stamp_ns == -1 && PyErr_Occurred()) {
            PyErr_Clear();
            return 0;
        }
    }
    return 1;
}

static PyObject *dont_wait, *no_flags; /* of ZeroMQ, as ints */

/* The clock of Python's `time.monotonic_ns`. */
static int64_t monotonic_ns(void) {
#ifdef __APPLE__
    return (int64_t)clock_gettime_nsec_np(CLOCK_UPTIME_RAW);
#else
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
#endif
}

static PyObject *none_or_error(PyObject *made) {
    Py_XDECREF(made);
    if (PyErr_Occurred()) return NULL;
    Py_RETURN_NONE;
}

static int arguments_are(Py_ssize_t count, Py_ssize_t wanted) {
    if (count == wanted) return 1;
    PyErr_Format(PyExc_TypeError, "expected %zd arguments, got %zd", wanted, count);
    return 0;
}

/* A whole frame; NULL without error if the message is not as usual. */
static PyObject *make_frame(
    const Flat *flat, PyObject *message, Layout *layout, uint64_t sequence, int64_t publish_ns) {
    PyObject *frame = PyBytes_FromStringAndSize(NULL, HEADER_SIZE + layout->end);
    if (frame == NULL) return NULL;
    char *out = PyBytes_AS_STRING(frame);
    if (!write_body(flat, message, layout, out + HEADER_SIZE)) {
        Py_DECREF(frame);
        return NULL;
    }
    memcpy(out, flat->head, HEAD_SIZE);
    const uint64_t rest[5] = {sequence, (uint64_t)layout->stamp_ns, (uint64_t)publish_ns, (uint64_t)layout->end, 0};
    memcpy(out + HEAD_SIZE, rest, sizeof rest);
    return frame;
}

PyDoc_STRVAR(frame_doc,
"frame($self, message, sequence, publish_ns, limit, /)\n--\n\n"
"A whole frame: the head, the rest of the header, the body; None if the message is not as usual, or its body has\n"
"more than `limit` bytes.");

static PyObject *flat_frame(Flat *flat, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 4)) return NULL;
    PyObject *message = arguments[0];
    const uint64_t sequence = PyLong_AsUnsignedLongLong(arguments[1]);
    const int64_t publish_ns = PyLong_AsLongLong(arguments[2]);
    const Py_ssize_t limit = PyLong_AsSsize_t(arguments[3]);
    if (PyErr_Occurred()) return NULL;
    Layout layout = {.stamp_ns = 0};
    if (!flat->has_head || !lay_out(flat, message, &layout) || layout.end > limit) Py_RETURN_NONE;
    PyObject *frame = make_frame(flat, message, &layout, sequence, publish_ns);
    return frame == NULL ? none_or_error(NULL) : frame;
}

/* A record of a batch; NULL without error if the message is not as usual. */
static PyObject *make_record(const Flat *flat, PyObject *message, int64_t publish_ns, Py_ssize_t limit) {
    Layout layout = {.stamp_ns = 0};
    if (!lay_out(flat, message, &layout) || layout.end > limit) return NULL;
    const Py_ssize_t padded = align_to(layout.end, 8);
    PyObject *record = PyBytes_FromStringAndSize(NULL, RECORD_SIZE + padded);
    if (record == NULL) return NULL;
    char *out = PyBytes_AS_STRING(record);
    if (!write_body(flat, message, &layout, out + RECORD_SIZE)) {
        Py_DECREF(record);
        return NULL;
    }
    memset(out + RECORD_SIZE + layout.end, 0, (size_t)(padded - layout.end));
    memcpy(out, &layout.stamp_ns, 8);
    memcpy(out + 8, &publish_ns, 8);
    const uint32_t sizes[2] = {(uint32_t)layout.end, 0};
    memcpy(out + 16, sizes, sizeof sizes);
    return record;
}

PyDoc_STRVAR(record_doc,
"record($self, message, publish_ns, limit, /)\n--\n\n"
"A record of a batch, padded to 8 bytes; None as for `frame`.");

static PyObject *flat_record(Flat *flat, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 3)) return NULL;
    const int64_t publish_ns = PyLong_AsLongLong(arguments[1]);
    const Py_ssize_t limit = PyLong_AsSsize_t(arguments[2]);
    if (PyErr_Occurred()) return NULL;
    PyObject *record = make_record(flat, arguments[0], publish_ns, limit);
    return record == NULL ? none_or_error(NULL) : record;
}

PyDoc_STRVAR(encode_doc,
"encode($self, message, limit, /)\n--\n\n"
"The body of a message; None as for `frame`.");

static PyObject *flat_encode(Flat *flat, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 2)) return NULL;
    const Py_ssize_t limit = PyLong_AsSsize_t(arguments[1]);
    if (limit == -1 && PyErr_Occurred()) return NULL;
    Layout layout = {.stamp_ns = 0};
    if (!lay_out(flat, arguments[0], &layout) || layout.end > limit) Py_RETURN_NONE;
    PyObject *body = PyBytes_FromStringAndSize(NULL, layout.end);
    if (body == NULL) return NULL;
    if (!write_body(flat, arguments[0], &layout, PyBytes_AS_STRING(body))) return none_or_error(body);
    return body;
}

/* A read-only view of an array's bytes in `owner`; a new reference. */
static PyObject *view_of(const Field *field, const npy_intp *shape, const char *data, PyObject *owner) {
    Py_INCREF(field->dtype);
    PyObject *array = PyArray_NewFromDescr(
        &PyArray_Type, field->dtype, field->rank, shape, NULL, (void *)data, 0, NULL);
    if (array == NULL) return NULL;
    Py_INCREF(owner);
    if (PyArray_SetBaseObject((PyArrayObject *)array, owner) < 0) {
        Py_DECREF(array);
        return NULL;
    }
    PyArray_UpdateFlags((PyArrayObject *)array, NPY_ARRAY_ALIGNED | NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_F_CONTIGUOUS);
    return array;
}

/* The value of a field that is no number; NULL without error if the body is malformed. */
static PyObject *read_item(
    const Field *field, const char *body, Py_ssize_t size, Py_ssize_t *left, npy_intp *dimensions, PyObject *owner) {
    const char *place = body + field->offset;
    if (field->kind == BOOL) {
        if ((unsigned char)*place > 1) return NULL;
        return PyBool_FromLong(*place);
    }
    if (field->kind == FIXED) return view_of(field, field->shape, place, owner);
    uint32_t numbers[2 + RANK_MAX];
    memcpy(numbers, place, 4 * (size_t)(2 + (field->kind == VARIABLE ? field->rank : 0)));
    const Py_ssize_t start = numbers[0];
    Py_ssize_t bytes = numbers[1];
    npy_intp shape[RANK_MAX];
    if (field->kind == VARIABLE) {
        if (numbers[1] != field->head) return NULL;
        bytes = field->itemsize;
        for (int axis = 0; axis < field->rank; ++axis) {
            shape[axis] = numbers[2 + axis];
            if (field->shape[axis] >= 0 && field->shape[axis] != shape[axis]) return NULL;
            const int name = field->names[axis];
            if (name >= 0) {
                if (dimensions[name] >= 0 && dimensions[name] != shape[axis]) return NULL;
                dimensions[name] = shape[axis];
            }
            if (shape[axis] != 0 && bytes > BODY_LIMIT / shape[axis]) return NULL;
            bytes *= shape[axis];
        }
    }
    *left -= bytes;
    if (*left < 0 || start > size || bytes > size - start) return NULL;
    if (field->kind == VARIABLE) return view_of(field, shape, body + start, owner);
    if (field->kind == BYTES) return PyBytes_FromStringAndSize(body + start, bytes);
    PyObject *text = PyUnicode_DecodeUTF8(body + start, bytes, NULL);
    if (text == NULL && PyErr_ExceptionMatches(PyExc_UnicodeDecodeError)) PyErr_Clear();
    return text;
}

/* The message of a body within `owner`; NULL without error if it is malformed. */
static PyObject *read_body(const Flat *flat, PyObject *owner, const char *body, Py_ssize_t size) {
    if (size < flat->block) return NULL;
    PyObject *message = flat->cls->tp_alloc(flat->cls, 0);
    if (message == NULL) return NULL;
    npy_intp dimensions[DIMENSIONS_MAX];
    for (int name = 0; name < flat->dimension_count; ++name) dimensions[name] = -1;
    Py_ssize_t left = size - flat->block;
    if (left > 0 && !flat->has_tail) {
        Py_DECREF(message);
        return NULL;
    }
    for (Py_ssize_t index = 0; index < flat->count; ++index) {
        const Field *field = &flat->fields[index];
        PyObject *value = field->kind == NUMBER
            ? read_number(field->code, body + field->offset)
            : read_item(field, body, size, &left, dimensions, owner);
        if (value == NULL) {
            Py_DECREF(message);
            return NULL;
        }
        *place_of(field, message) = value;
    }
    return message;
}

PyDoc_STRVAR(read_doc,
"read($self, frame, /)\n--\n\n"
"A frame to its sequence, publish_ns and message; None if it does not begin with the head, or is not as usual.\n"
"Arrays of the message are read-only views of the frame.");

/* The message in the slot that a descriptor names; NULL without error if it is not as usual. */
static PyObject *read_slot(const Flat *flat, PyObject *frame, uint64_t *sequence, int64_t *publish_ns) {
    const char *bytes = PyBytes_AS_STRING(frame), *body;
    if (PyBytes_GET_SIZE(frame) != SLOT_FRAME_SIZE || memcmp(bytes, flat->head, 3)
        || memcmp(bytes + 4, flat->head + 4, HEAD_SIZE - 4))
        return NULL;
    Py_ssize_t size;
    PyObject *lease = take_lease(flat->slots, bytes, &body, &size);
    if (lease == NULL) return NULL;
    PyObject *message = read_body(flat, lease, body, size);
    if (message == NULL) {
        cancel_lease(lease);
        return NULL;
    }
    Py_DECREF(lease);
    memcpy(sequence, bytes + HEAD_SIZE, 8);
    memcpy(publish_ns, bytes + HEAD_SIZE + 16, 8);
    return message;
}

/* What a plain frame of this publisher says; NULL without error if it is none. */
static PyObject *read_frame(const Flat *flat, PyObject *frame, uint64_t *sequence, int64_t *publish_ns) {
    if (!flat->has_head || !PyBytes_CheckExact(frame) || PyBytes_GET_SIZE(frame) < HEADER_SIZE) return NULL;
    const char *bytes = PyBytes_AS_STRING(frame);
    if (bytes[3] == 'S' && flat->slots != NULL) return read_slot(flat, frame, sequence, publish_ns);
    if (memcmp(bytes, flat->head, HEAD_SIZE)) return NULL;
    uint64_t rest[5];
    memcpy(rest, bytes + HEAD_SIZE, sizeof rest);
    const Py_ssize_t size = PyBytes_GET_SIZE(frame) - HEADER_SIZE;
    if (rest[3] != (uint64_t)size) return NULL;
    *sequence = rest[0];
    *publish_ns = (int64_t)rest[2];
    return read_body(flat, frame, bytes + HEADER_SIZE, size);
}

static PyObject *flat_read(Flat *flat, PyObject *frame) {
    uint64_t sequence;
    int64_t publish_ns;
    PyObject *message = read_frame(flat, frame, &sequence, &publish_ns);
    if (message == NULL) return none_or_error(NULL);
    return Py_BuildValue("KLN", (unsigned long long)sequence, (long long)publish_ns, message);
}

static PyObject *reader_take(PyObject *self, int may_wait);
static PyTypeObject PipeReaderType;

/* The next frame that `receive` has, which raises `again` if it has none: then NULL without error. */
static PyObject *take_frame(PyObject *receive, PyObject *again, int may_wait) {
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

PyDoc_STRVAR(drain_doc,
"drain($self, receive, again, messages, expected, limit, latency, clock_offset_ns, may_wait, /)\n--\n\n"
"Read plain frames that follow one another, and append their messages.\n\n"
"Args:\n"
"    receive: Called with DONTWAIT (1); returns a frame.\n"
"    again: What it raises when there is none.\n"
"    messages: A deque or list; its `append` is called.\n"
"    expected: Sequence of the next message; -1: not known.\n"
"    limit: Most messages to read.\n"
"    latency: Counts by powers of two of a nanosecond; every eighth message is entered.\n"
"    clock_offset_ns: What to add to the publisher's clock to read it on ours [ns].\n"
"    may_wait: Whether to wait a little for the first: call `receive` without DONTWAIT.\n\n"
"Returns:\n"
"    The sequence expected next, how many were read, and what ended it: None where there were no more or the limit\n"
"    was reached, or a frame that was taken from the socket and is something else, or out of sequence.\n");

static int note_latency(PyObject *latency, int64_t elapsed_ns) {
    Py_ssize_t bucket = 0;
    for (uint64_t left = elapsed_ns > 0 ? (uint64_t)elapsed_ns : 0; left; left >>= 1) ++bucket;
    const Py_ssize_t last = PyList_GET_SIZE(latency) - 1;
    if (bucket > last) bucket = last;
    const long long count = PyLong_AsLongLong(PyList_GET_ITEM(latency, bucket));
    if (count == -1 && PyErr_Occurred()) return 0;
    PyObject *more = PyLong_FromLongLong(count + 1);
    return more != NULL && PyList_SetItem(latency, bucket, more) == 0;
}

static PyObject *flat_drain(Flat *flat, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 8)) return NULL;
    PyObject *receive = arguments[0], *again = arguments[1], *messages = arguments[2], *latency = arguments[5];
    int64_t expected = PyLong_AsLongLong(arguments[3]);
    const Py_ssize_t limit = PyLong_AsSsize_t(arguments[4]);
    const int64_t clock_offset_ns = PyLong_AsLongLong(arguments[6]);
    const int may_wait = PyObject_IsTrue(arguments[7]);
    if (PyErr_Occurred()) return NULL;
    if (!PyList_Check(latency) || PyList_GET_SIZE(latency) == 0) {
        PyErr_SetString(PyExc_TypeError, "latency must be a list of counts");
        return NULL;
    }
    PyObject *append = PyObject_GetAttrString(messages, "append");
    if (append == NULL) return NULL;
    PyObject *frame = NULL;
    Py_ssize_t read = 0;
    for (; read < limit; ++read) {
        frame = take_frame(receive, again, may_wait && read == 0);
        if (frame == NULL) {
            if (PyErr_Occurred()) goto failed;
            break;
        }
        uint64_t sequence;
        int64_t publish_ns;
        if (flat->has_head && PyBytes_CheckExact(frame) && PyBytes_GET_SIZE(frame) >= HEADER_SIZE) {
            memcpy(&sequence, PyBytes_AS_STRING(frame) + HEAD_SIZE, 8);
            if (sequence != (uint64_t)expected) break;
        }
        PyObject *message = read_frame(flat, frame, &sequence, &publish_ns);
        if (message == NULL) {
            if (PyErr_Occurred()) goto failed;
            break;
        }
        Py_CLEAR(frame);
        expected += 1;
        PyObject *appended = PyObject_CallOneArg(append, message);
        Py_DECREF(message);
        if (appended == NULL) goto failed;
        Py_DECREF(appended);
        if (read % 8 == 0 && !note_latency(latency, monotonic_ns() - publish_ns - clock_offset_ns)) goto failed;
    }
    Py_DECREF(append);
    return Py_BuildValue("LnN", (long long)expected, read, frame != NULL ? frame : Py_NewRef(Py_None));
failed:
    Py_XDECREF(frame);
    Py_DECREF(append);
    return NULL;
}

PyDoc_STRVAR(gather_doc,
"gather($self, receive, again, expected, limit, latency, clock_offset_ns, /)\n--\n\n"
"Read plain frames that follow one another, for types of fixed size, and join their bodies.\n\n"
"Returns:\n"
"    The sequence expected next, the bodies one after the other, how many they are, and what ended it, as `drain`.\n");

static PyObject *flat_gather(Flat *flat, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 6)) return NULL;
    PyObject *latency = arguments[4];
    int64_t expected = PyLong_AsLongLong(arguments[2]);
    const Py_ssize_t limit = PyLong_AsSsize_t(arguments[3]);
    const int64_t clock_offset_ns = PyLong_AsLongLong(arguments[5]);
    if (PyErr_Occurred()) return NULL;
    if (!PyList_Check(latency) || PyList_GET_SIZE(latency) == 0) {
        PyErr_SetString(PyExc_TypeError, "latency must be a list of counts");
        return NULL;
    }
    const Py_ssize_t size = flat->block;
    if (flat->has_tail || !flat->has_head) {
        PyErr_SetString(PyExc_ValueError, "only bodies of fixed size are gathered");
        return NULL;
    }
    PyObject *frames[GATHER_MAX], *frame = NULL, *bodies = NULL;
    Py_ssize_t found = 0;
    while (found < limit && found < GATHER_MAX) {
        frame = take_frame(arguments[0], arguments[1], 0);
        if (frame == NULL) {
            if (PyErr_Occurred()) goto done;
            break;
        }
        if (!PyBytes_CheckExact(frame) || PyBytes_GET_SIZE(frame) != HEADER_SIZE + size) break;
        const char *bytes = PyBytes_AS_STRING(frame);
        uint64_t rest[5];
        memcpy(rest, bytes + HEAD_SIZE, sizeof rest);
        if (memcmp(bytes, flat->head, HEAD_SIZE) || rest[0] != (uint64_t)expected || rest[3] != (uint64_t)size) break;
        frames[found] = frame;
        frame = NULL;
        expected += 1;
        const int64_t elapsed_ns = monotonic_ns() - (int64_t)rest[2] - clock_offset_ns;
        if (found++ % 8 == 0 && !note_latency(latency, elapsed_ns)) goto done;
    }
    bodies = PyBytes_FromStringAndSize(NULL, found * size);
    for (Py_ssize_t index = 0; bodies != NULL && index < found; ++index) {
        memcpy(PyBytes_AS_STRING(bodies) + index * size, PyBytes_AS_STRING(frames[index]) + HEADER_SIZE, (size_t)size);
    }
done:
    for (Py_ssize_t index = 0; index < found; ++index) Py_DECREF(frames[index]);
    if (bodies == NULL) {
        Py_XDECREF(frame);
        return NULL;
    }
    return Py_BuildValue("LNnN", (long long)expected, bodies, found, frame != NULL ? frame : Py_NewRef(Py_None));
}

PyDoc_STRVAR(records_doc,
"records($self, frame, count, /)\n--\n\n"
"The messages of a batch's records, as a list; None if they are not as usual, or do not fill the frame.");

static PyObject *flat_records(Flat *flat, PyObject *const *arguments, Py_ssize_t argument_count) {
    if (!arguments_are(argument_count, 2)) return NULL;
    PyObject *frame = arguments[0];
    const Py_ssize_t count = PyLong_AsSsize_t(arguments[1]);
    if (count == -1 && PyErr_Occurred()) return NULL;
    if (!PyBytes_CheckExact(frame) || count < 0) Py_RETURN_NONE;
    const char *bytes = PyBytes_AS_STRING(frame);
    const Py_ssize_t end = PyBytes_GET_SIZE(frame);
    if (end < HEADER_SIZE || count > (end - HEADER_SIZE) / RECORD_SIZE) Py_RETURN_NONE;
    PyObject *messages = PyList_New(count);
    Py_ssize_t offset = HEADER_SIZE;
    for (Py_ssize_t index = 0; messages != NULL && index < count; ++index) {
        uint32_t sizes[2];
        PyObject *message = NULL;
        if (end - offset >= RECORD_SIZE) {
            memcpy(sizes, bytes + offset + 16, sizeof sizes);
            offset += RECORD_SIZE;
            if (sizes[1] == 0 && align_to(sizes[0], 8) <= end - offset) {
                message = read_body(flat, frame, bytes + offset, sizes[0]);
                offset += align_to(sizes[0], 8);
            }
        }
        if (message == NULL) return none_or_error(messages);
        PyList_SET_ITEM(messages, index, message);
    }
    if (messages != NULL && offset != end) return none_or_error(messages);
    return messages;
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

static PyObject *flat_decode(Flat *flat, PyObject *const *arguments, Py_ssize_t count) {
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
    PyObject *message = read_body(flat, buffer, bytes + offset, size);
    return message == NULL ? none_or_error(NULL) : message;
}

/* Making a Flat */

static int take_array(Flat *flat, Field *field, PyObject *dtype, PyObject *shape, PyObject *names, uint32_t head) {
    if (!PyArray_DescrCheck(dtype) || !PyTuple_Check(shape) || !PyTuple_Check(names)
        || PyTuple_GET_SIZE(shape) != PyTuple_GET_SIZE(names)) {
        PyErr_SetString(PyExc_TypeError, "an array has a dtype, and tuples of as many sizes as names");
        return 0;
    }
    if (PyTuple_GET_SIZE(shape) > RANK_MAX) {
        PyErr_Format(PyExc_ValueError, "arrays have at most %d dimensions here", RANK_MAX);
        return 0;
    }
    field->rank = (int)PyTuple_GET_SIZE(shape);
    for (int axis = 0; axis < field->rank; ++axis) {
        field->shape[axis] = PyLong_AsSsize_t(PyTuple_GET_ITEM(shape, axis));
        field->names[axis] = (int)PyLong_AsLong(PyTuple_GET_ITEM(names, axis));
        if (PyErr_Occurred()) return 0;
        if (field->names[axis] >= DIMENSIONS_MAX) {
            PyErr_Format(PyExc_ValueError, "at most %d shared dimensions here", DIMENSIONS_MAX);
            return 0;
        }
        if (field->names[axis] >= flat->dimension_count) flat->dimension_count = field->names[axis] + 1;
    }
    Py_INCREF(dtype);
    field->dtype = (PyArray_Descr *)dtype;
    PyObject *itemsize = PyObject_GetAttrString(dtype, "itemsize");
    if (itemsize == NULL) return 0;
    field->itemsize = PyLong_AsSsize_t(itemsize);
    Py_DECREF(itemsize);
    field->head = head;
    return !PyErr_Occurred();
}

static int take_field(Flat *flat, PyObject *row) {
    Field *field = &flat->fields[flat->count];
    int kind, code;
    Py_ssize_t offset;
    unsigned int head;
    PyObject *name, *dtype, *shape, *names;
    if (!PyArg_ParseTuple(row, "UiCnOOOI", &name, &kind, &code, &offset, &dtype, &shape, &names, &head)) return 0;
    const Py_ssize_t slot = slot_of(flat->cls, name);
    if (slot < 0) return 0;
    if (kind < NUMBER || kind > BYTES || (kind == NUMBER && !strchr("bhiqBHIQfd", code)) || offset < 0
        || offset >= flat->block) {
        PyErr_Format(PyExc_ValueError, "%s.%U: kind %d, code %c, offset %zd", flat->cls->tp_name, name, kind, code, offset);
        return 0;
    }
    field->slot = slot;
    field->kind = (Kind)kind;
    field->code = (char)code;
    field->offset = offset;
    flat->has_tail |= kind >= VARIABLE;
    if (kind == FIXED || kind == VARIABLE) {
        if (!take_array(flat, field, dtype, shape, names, head)) return 0;
    }
    flat->count += 1;
    return 1;
}

static PyObject *flat_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"cls", "fields", "block", "stamp", "head", NULL};
    PyObject *cls, *fields, *head;
    Py_ssize_t block, stamp;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "O!O!nnS:Flat", names, &PyType_Type, &cls, &PyList_Type,
                                     &fields, &block, &stamp, &head))
        return NULL;
    if (PyList_GET_SIZE(fields) > FIELDS_MAX || block < 0 || block >= BODY_LIMIT) {
        PyErr_Format(PyExc_ValueError, "at most %d fields here", FIELDS_MAX);
        return NULL;
    }
    const Py_ssize_t head_size = PyBytes_GET_SIZE(head);
    if (head_size != 0 && head_size != HEAD_SIZE) {
        PyErr_Format(PyExc_ValueError, "a head has %d bytes, got %zd", HEAD_SIZE, head_size);
        return NULL;
    }
    Flat *flat = (Flat *)type->tp_alloc(type, 0);
    if (flat == NULL) return NULL;
    flat->fields = PyMem_Calloc((size_t)PyList_GET_SIZE(fields) + 1, sizeof(Field));
    if (flat->fields == NULL) {
        Py_DECREF(flat);
        return PyErr_NoMemory();
    }
    memcpy(flat->head, PyBytes_AS_STRING(head), (size_t)head_size);
    flat->has_head = head_size != 0;
    Py_INCREF(cls);
    flat->cls = (PyTypeObject *)cls;
    flat->block = block;
    for (Py_ssize_t index = 0; index < PyList_GET_SIZE(fields); ++index) {
        if (!take_field(flat, PyList_GET_ITEM(fields, index))) {
            Py_DECREF(flat);
            return NULL;
        }
    }
    if (stamp >= flat->count || (stamp >= 0 && flat->fields[stamp].kind != NUMBER)) {
        PyErr_Format(PyExc_ValueError, "field %zd is no stamp", stamp);
        Py_DECREF(flat);
        return NULL;
    }
    flat->stamp = stamp;
    return (PyObject *)flat;
}

static int flat_traverse(Flat *flat, visitproc visit, void *arg) {
    Py_VISIT(flat->cls);
    Py_VISIT(flat->slots);
    return 0;
}

static int flat_clear(Flat *flat) {
    Py_CLEAR(flat->cls);
    Py_CLEAR(flat->slots);
    return 0;
}

static void flat_dealloc(Flat *flat) {
    PyObject_GC_UnTrack(flat);
    flat_clear(flat);
    for (Py_ssize_t index = 0; flat->fields != NULL && index <= flat->count; ++index)
        Py_XDECREF(flat->fields[index].dtype);
    PyMem_Free(flat->fields);
    Py_TYPE(flat)->tp_free((PyObject *)flat);
}

static PyMethodDef flat_methods[] = {
    {"frame", (PyCFunction)(void (*)(void))flat_frame, METH_FASTCALL, frame_doc},
    {"record", (PyCFunction)(void (*)(void))flat_record, METH_FASTCALL, record_doc},
    {"encode", (PyCFunction)(void (*)(void))flat_encode, METH_FASTCALL, encode_doc},
    {"read", (PyCFunction)flat_read, METH_O, read_doc},
    {"drain", (PyCFunction)(void (*)(void))flat_drain, METH_FASTCALL, drain_doc},
    {"gather", (PyCFunction)(void (*)(void))flat_gather, METH_FASTCALL, gather_doc},
    {"records", (PyCFunction)(void (*)(void))flat_records, METH_FASTCALL, records_doc},
    {"decode", (PyCFunction)(void (*)(void))flat_decode, METH_FASTCALL, decode_doc},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef flat_members[] = {
    {"slots", T_OBJECT, offsetof(Flat, slots), 0, "A `SlotView`: descriptors of its ring are read as messages; None: none are."},
    {NULL, 0, 0, 0, NULL},
};

PyDoc_STRVAR(flat_doc,
"Flat(cls, fields, block, stamp, head)\n--\n\n"
"Writes and reads the messages of one flat type.\n\n"
"Args:\n"
"    cls: The class: its fields are slots.\n"
"    fields: Name, kind, code, offset in the block, dtype, sizes (-1: any), names (-1: none) and head of each field.\n"
"    block: Size of the block [bytes].\n"
"    stamp: Index of the field that is the stamp, -1: none.\n"
"    head: What frames begin with, 24 bytes; empty: this one makes and reads no frames.\n");

static PyTypeObject FlatType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Flat",
    .tp_doc = flat_doc,
    .tp_basicsize = sizeof(Flat),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .tp_new = flat_new,
    .tp_traverse = (traverseproc)flat_traverse,
    .tp_clear = (inquiry)flat_clear,
    .tp_dealloc = (destructor)flat_dealloc,
    .tp_methods = flat_methods,
    .tp_members = flat_members,
};

/* Gate */

typedef struct {
    PyObject_HEAD
    vectorcallfunc vectorcall;
    Flat *flat;
    PyObject *acquire, *release, *slowly, *retry, *again;
    PyObject *sends; /* a tuple; empty or NULL: every message goes the long way */
    Py_ssize_t limit;
    uint64_t sequence;
    int64_t bytes;
    int64_t refresh_ns;
    /* Where larger bodies go; NULL or None: the long way. */
    PyObject *ledger;
    PyObject *prepare, *large_acquire, *large_release, *finish;
    /* A batch that is being collected: its first record is put in by Python, which starts the clock. */
    PyObject *records; /* a list; NULL or None: messages are not collected */
    PyObject *flush;
    int64_t batch_bytes, batch_start_ns, last_ns;
    int64_t batch_count_max, batch_bytes_max, batch_ns_max;
} Gate;

PyDoc_STRVAR(gate_doc,
"Gate(flat, acquire, release, slowly, retry, again, limit, flush)\n--\n\n"
"Called with a message, it sends it, or adds it to a batch that has begun; see `gate.py`.\n\n"
"Args:\n"
"    flat: Makes the frames; has a head.\n"
"    acquire: Takes the lock.\n"
"    release: Gives it back.\n"
"    slowly: Called without the lock with a message that has to go the long way.\n"
"    retry: Called with the lock held, a frame, and that of `sends` which had no room for it.\n"
"    again: What that raised.\n"
"    limit: Most bytes of a body.\n"
"    flush: Called with the lock held when a batch is full; sends it.\n");

/* Add to the batch that is being collected, with the lock held; NULL as below. */
static PyObject *gate_collect(Gate *gate, PyObject *message) {
    const int64_t now_ns = monotonic_ns();
    if (now_ns >= gate->refresh_ns) return NULL;
    PyObject *record = make_record(gate->flat, message, now_ns, gate->limit);
    if (record == NULL) return NULL;
    gate->batch_bytes += PyBytes_GET_SIZE(record);
    const int failed = PyList_Append(gate->records, record);
    Py_DECREF(record);
    if (failed) return NULL;
    gate->sequence += 1;
    gate->last_ns = now_ns;
    if (PyList_GET_SIZE(gate->records) >= gate->batch_count_max || gate->batch_bytes >= gate->batch_bytes_max
        || now_ns - gate->batch_start_ns >= gate->batch_ns_max)
        return PyObject_CallNoArgs(gate->flush);
    Py_RETURN_TRUE;
}

/* See who has come and gone, now and then; 0 with an error set, or if nobody is there to do it. */
static int gate_prepare(Gate *gate, int64_t now_ns) {
    if (gate->prepare == NULL) return 0;
    PyObject *prepared = PyObject_CallFunction(gate->prepare, "L", (long long)now_ns);
    Py_XDECREF(prepared);
    return prepared != NULL;
}

/* Send a frame to all; the lock is held. */
static PyObject *gate_send_frame(Gate *gate, PyObject *frame) {
    PyObject *sends = Py_NewRef(gate->sends); /* who comes or goes meanwhile replaces it */
    int on_time = 1;
    for (Py_ssize_t place = 0; on_time >= 0 && place < PyTuple_GET_SIZE(sends); ++place) {
        PyObject *arguments[3] = {NULL, frame, dont_wait};
        PyObject *sent = PyObject_Vectorcall(
            PyTuple_GET_ITEM(sends, place), arguments + 1, 2 | PY_VECTORCALL_ARGUMENTS_OFFSET, NULL);
        if (sent == NULL && PyErr_ExceptionMatches(gate->again)) {
            PyErr_Clear();
            sent = PyObject_CallFunction(gate->retry, "OO", frame, PyTuple_GET_ITEM(sends, place));
            if (sent == Py_False) on_time = 0;
        }
        if (sent == NULL) on_time = -1;
        Py_XDECREF(sent);
    }
    Py_DECREF(sends);
    return on_time < 0 ? NULL : PyBool_FromLong(on_time);
}

/* Take the lock back, whatever signals come; 0 with an error set if one of their handlers raised. */
static int gate_relock(Gate *gate) {
    PyObject *acquired, *type = NULL, *value = NULL, *traceback = NULL;
    while ((acquired = PyObject_CallNoArgs(gate->acquire)) == NULL) {
        Py_XDECREF(type);
        Py_XDECREF(value);
        Py_XDECREF(traceback);
        PyErr_Fetch(&type, &value, &traceback);
    }
    Py_DECREF(acquired);
    if (type == NULL) return 1;
    PyErr_Restore(type, value, traceback);
    return 0;
}

/* Copy the arrays of a large message without the lock, which is held before and after; 0 with an error set. */
static int gate_copy(Gate *gate, PyObject *message, const Layout *layout, char *out) {
    const Flat *flat = gate->flat;
    PyObject *arrays[FIELDS_MAX];
    for (Py_ssize_t index = 0; index < flat->count; ++index) arrays[index] = *place_of(&flat->fields[index], message);
    hold_arrays(flat, layout, arrays, 1);
    PyObject *released = PyObject_CallNoArgs(gate->release);
    if (released == NULL) {
        hold_arrays(flat, layout, arrays, -1);
        return 0;
    }
    Py_DECREF(released);
    Py_BEGIN_ALLOW_THREADS
    copy_arrays(flat, layout, out);
    Py_END_ALLOW_THREADS
    const int locked = gate_relock(gate);
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    hold_arrays(flat, layout, arrays, -1);
    PyErr_Restore(type, value, traceback);
    return locked;
}

/* Write a large message into a slot and send its descriptor, with the lock held; NULL as below.

   While much is copied others may have the lock: then `large_acquire` keeps other large messages away, and whatever
   has changed meanwhile is left to `finish`. */
static PyObject *gate_send_slot(Gate *gate, PyObject *message, Layout *layout, int64_t now_ns) {
    Ledger *ledger = gate->ledger == NULL ? NULL : ledger_of(gate->ledger);
    if (ledger == NULL || gate->records != NULL || !ledger_has_room(ledger)) return NULL;
    const int unlocked = layout->end >= UNLOCKED_BYTES;
    if (unlocked) {
        PyObject *acquired = PyObject_CallOneArg(gate->large_acquire, Py_False);
        Py_XDECREF(acquired);
        if (acquired != Py_True) return NULL;
    }
    PyObject *kept = Py_NewRef(gate->ledger), *result = NULL;
    const Py_ssize_t slot = ledger_acquire(ledger, layout->end);
    if (slot >= 0) {
        char *out = ledger_memory(ledger, slot);
        layout->defers = 1;
        int written = write_body(gate->flat, message, layout, out);
        ledger_use(ledger, 1);
        if (written && unlocked) written = gate_copy(gate, message, layout, out);
        else if (written) copy_arrays(gate->flat, layout, out);
        ledger_use(ledger, -1);
        if (!written) {
            ledger_abandon(ledger, slot);
        } else if (gate->ledger != kept || gate->refresh_ns == 0 || !ledger_has_room(ledger)) {
            result = PyObject_CallFunction(gate->finish, "nnLL", slot, layout->end, (long long)layout->stamp_ns, (long long)now_ns);
        } else {
            PyObject *frame = ledger_commit(ledger, slot, gate->sequence, layout->stamp_ns, now_ns, layout->end);
            if (frame == NULL) {
                ledger_abandon(ledger, slot);
            } else {
                gate->sequence += 1;
                gate->bytes += layout->end;
                result = gate_send_frame(gate, frame);
                Py_DECREF(frame);
            }
        }
    }
    Py_DECREF(kept);
    if (unlocked) {
        PyObject *type, *value, *traceback;
        PyErr_Fetch(&type, &value, &traceback);
        PyObject *released = PyObject_CallNoArgs(gate->large_release);
        if (released == NULL) PyErr_Clear(); /* it was ours */
        Py_XDECREF(released);
        PyErr_Restore(type, value, traceback);
    }
    return result;
}

/* Send with the lock held; NULL without error if the message has to go the long way. */
static PyObject *gate_send(Gate *gate, PyObject *message) {
    if (gate->records != NULL && PyList_CheckExact(gate->records) && PyList_GET_SIZE(gate->records))
        return gate_collect(gate, message);
    const int64_t now_ns = monotonic_ns();
    if (now_ns >= gate->refresh_ns && !gate_prepare(gate, now_ns)) return NULL;
    if (gate->sends == NULL || !PyTuple_CheckExact(gate->sends) || !PyTuple_GET_SIZE(gate->sends)) return NULL;
    Layout layout = {.stamp_ns = 0};
    if (!lay_out(gate->flat, message, &layout)) return NULL;
    if (layout.end > gate->limit) return gate_send_slot(gate, message, &layout, now_ns);
    PyObject *frame = make_frame(gate->flat, message, &layout, gate->sequence, now_ns);
    if (frame == NULL) return NULL;
    gate->sequence += 1;
    gate->bytes += layout.end;
    PyObject *sent = gate_send_frame(gate, frame);
    Py_DECREF(frame);
    return sent;
}

static PyObject *gate_call(PyObject *self, PyObject *const *arguments, size_t flags, PyObject *keywords) {
    Gate *gate = (Gate *)self;
    if (PyVectorcall_NARGS(flags) != 1 || (keywords != NULL && PyTuple_GET_SIZE(keywords))) {
        PyErr_SetString(PyExc_TypeError, "publish() takes one message, by position");
        return NULL;
    }
    PyObject *acquired = PyObject_CallNoArgs(gate->acquire);
    if (acquired == NULL) return NULL;
    Py_DECREF(acquired);
    PyObject *result = gate_send(gate, arguments[0]);
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    PyObject *released = PyObject_CallNoArgs(gate->release);
    if (released == NULL) {
        Py_XDECREF(result);
        Py_XDECREF(type);
        Py_XDECREF(value);
        Py_XDECREF(traceback);
        return NULL;
    }
    Py_DECREF(released);
    if (type != NULL) {
        PyErr_Restore(type, value, traceback);
        return NULL;
    }
    return result != NULL ? result : PyObject_CallOneArg(gate->slowly, arguments[0]);
}

static PyObject *gate_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"flat", "acquire", "release", "slowly", "retry", "again", "limit", "flush", NULL};
    PyObject *flat, *acquire, *release, *slowly, *retry, *again, *flush;
    Py_ssize_t limit;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "O!OOOOOnO:Gate", names, &FlatType, &flat, &acquire, &release,
                                     &slowly, &retry, &again, &limit, &flush))
        return NULL;
    Gate *gate = (Gate *)type->tp_alloc(type, 0);
    if (gate == NULL) return NULL;
    gate->vectorcall = gate_call;
    gate->flat = (Flat *)Py_NewRef(flat);
    gate->acquire = Py_NewRef(acquire);
    gate->release = Py_NewRef(release);
    gate->slowly = Py_NewRef(slowly);
    gate->retry = Py_NewRef(retry);
    gate->again = Py_NewRef(again);
    gate->flush = Py_NewRef(flush);
    gate->limit = limit;
    return (PyObject *)gate;
}

static int gate_traverse(Gate *gate, visitproc visit, void *arg) {
    Py_VISIT(gate->flat);
    Py_VISIT(gate->acquire);
    Py_VISIT(gate->release);
    Py_VISIT(gate->slowly);
    Py_VISIT(gate->retry);
    Py_VISIT(gate->again);
    Py_VISIT(gate->sends);
    Py_VISIT(gate->ledger);
    Py_VISIT(gate->prepare);
    Py_VISIT(gate->large_acquire);
    Py_VISIT(gate->large_release);
    Py_VISIT(gate->finish);
    Py_VISIT(gate->records);
    Py_VISIT(gate->flush);
    return 0;
}

static int gate_clear(Gate *gate) {
    Py_CLEAR(gate->flat);
    Py_CLEAR(gate->acquire);
    Py_CLEAR(gate->release);
    Py_CLEAR(gate->slowly);
    Py_CLEAR(gate->retry);
    Py_CLEAR(gate->again);
    Py_CLEAR(gate->sends);
    Py_CLEAR(gate->ledger);
    Py_CLEAR(gate->prepare);
    Py_CLEAR(gate->large_acquire);
    Py_CLEAR(gate->large_release);
    Py_CLEAR(gate->finish);
    Py_CLEAR(gate->records);
    Py_CLEAR(gate->flush);
    return 0;
}

static void gate_dealloc(Gate *gate) {
    PyObject_GC_UnTrack(gate);
    gate_clear(gate);
    Py_TYPE(gate)->tp_free((PyObject *)gate);
}

static PyMemberDef gate_members[] = {
    {"sends", T_OBJECT, offsetof(Gate, sends), 0, "Take a frame and flags; none: every message goes the long way."},
    {"ledger", T_OBJECT, offsetof(Gate, ledger), 0, "A `Ledger`: where larger bodies go; None: the long way."},
    {"prepare", T_OBJECT, offsetof(Gate, prepare), 0, "Called with the lock held and the time when `refresh_ns` is over."},
    {"large_acquire", T_OBJECT, offsetof(Gate, large_acquire), 0, "Called with False, takes the lock of large messages."},
    {"large_release", T_OBJECT, offsetof(Gate, large_release), 0, "Gives it back."},
    {"finish", T_OBJECT, offsetof(Gate, finish), 0, "Sends a written slot: number, size, stamp_ns, publish_ns."},
    {"records", T_OBJECT, offsetof(Gate, records), 0, "Those of the batch that is being collected; None: none is."},
    {"batch_bytes", T_LONGLONG, offsetof(Gate, batch_bytes), 0, "Their bytes."},
    {"batch_start_ns", T_LONGLONG, offsetof(Gate, batch_start_ns), 0, "When the first was published."},
    {"batch_count_max", T_LONGLONG, offsetof(Gate, batch_count_max), 0, "A batch of so many messages is full."},
    {"batch_bytes_max", T_LONGLONG, offsetof(Gate, batch_bytes_max), 0, "A batch of so many bytes is full."},
    {"batch_ns_max", T_LONGLONG, offsetof(Gate, batch_ns_max), 0, "A batch that is so old is sent."},
    {"last_ns", T_LONGLONG, offsetof(Gate, last_ns), 0, "When the last message was published."},
    {"sequence", T_ULONGLONG, offsetof(Gate, sequence), 0, "Of the next message."},
    {"bytes", T_LONGLONG, offsetof(Gate, bytes), 0, "Of all bodies so far."},
    {"refresh_ns", T_LONGLONG, offsetof(Gate, refresh_ns), 0, "When the next message goes the long way."},
    {NULL, 0, 0, 0, NULL},
};

static PyTypeObject GateType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Gate",
    .tp_doc = gate_doc,
    .tp_basicsize = sizeof(Gate),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_HAVE_VECTORCALL,
    .tp_vectorcall_offset = offsetof(Gate, vectorcall),
    .tp_call = PyVectorcall_Call,
    .tp_new = gate_new,
    .tp_traverse = (traverseproc)gate_traverse,
    .tp_clear = (inquiry)gate_clear,
    .tp_dealloc = (destructor)gate_dealloc,
    .tp_members = gate_members,
};

/* Pipes; see `pipe.py`, which does the same in Python. */

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

static PyObject *frame_argument(PyObject *const *arguments, Py_ssize_t count) {
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
    static char *names[] = {"fd", "again", NULL};
    int fd;
    PyObject *again;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "iO:PipeWriter", names, &fd, &again)) return NULL;
    PipeWriter *writer = (PipeWriter *)type->tp_alloc(type, 0);
    if (writer == NULL) return NULL;
    writer->fd = fd;
    writer->again = Py_NewRef(again);
    return (PyObject *)writer;
}

static void writer_dealloc(PipeWriter *writer) {
    if (writer->fd >= 0) close(writer->fd);
    Py_XDECREF(writer->again);
    Py_XDECREF(writer->left);
    Py_TYPE(writer)->tp_free((PyObject *)writer);
}

static PyMethodDef writer_methods[] = {
    {"send", (PyCFunction)(void (*)(void))writer_send, METH_FASTCALL, "Write a frame; `again` if there is no room."},
    {"offer", (PyCFunction)(void (*)(void))writer_offer, METH_FASTCALL, "Write a frame if there is room."},
    {"flush", (PyCFunction)writer_flush, METH_NOARGS, "Write the rest of a frame; whether all is written."},
    {"close", (PyCFunction)writer_close, METH_NOARGS, "Write no more."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject PipeWriterType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.PipeWriter",
    .tp_doc = "PipeWriter(fd, again)\n--\n\nThe publisher's end of a pipe, which owns the descriptor.",
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

/* Make room for a frame of `size` bytes from `begin` on, and for a read; 0: no memory. */
static int make_room(PipeReader *reader, Py_ssize_t size) {
    const Py_ssize_t held = reader->end - reader->begin;
    const Py_ssize_t wanted = (size > READ_BYTES ? size : READ_BYTES) + READ_BYTES;
    if (reader->capacity < wanted) {
        char *larger = PyMem_Malloc((size_t)wanted);
        if (larger == NULL) return 0;
        memcpy(larger, reader->buffer + reader->begin, (size_t)held);
        PyMem_Free(reader->buffer);
        reader->buffer = larger;
        reader->capacity = wanted;
    } else if (reader->begin > 0) {
        memmove(reader->buffer, reader->buffer + reader->begin, (size_t)held);
    }
    reader->begin = 0;
    reader->end = held;
    return 1;
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
        if (reader->capacity - reader->end < READ_BYTES || *size > reader->capacity - reader->begin) {
            if (!make_room(reader, *size)) {
                PyErr_NoMemory();
                return NULL;
            }
        }
        ssize_t count;
        do count = read(reader->fd, reader->buffer + reader->end, READ_BYTES);
        while (count < 0 && errno == EINTR);
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
};

static struct PyModuleDef native_module = {
    PyModuleDef_HEAD_INIT,
    .m_name = "cortex._native",
    .m_doc = "The way of a small message, in C.",
    .m_size = -1,
};

PyMODINIT_FUNC PyInit__native(void) {
    import_array();
    PyTypeObject *types[] = {&FlatType, &GateType, &PipeWriterType, &PipeReaderType};
    const char *names[] = {"Flat", "Gate", "PipeWriter", "PipeReader"};
    for (int index = 0; index < 4; ++index) {
        if (PyType_Ready(types[index]) < 0) return NULL;
    }
    dont_wait = PyLong_FromLong(1);
    no_flags = PyLong_FromLong(0);
    if (dont_wait == NULL || no_flags == NULL) return NULL;
    PyObject *module = PyModule_Create(&native_module);
    if (module == NULL) return NULL;
    for (int index = 0; index < 4; ++index) {
        if (PyModule_AddObjectRef(module, names[index], (PyObject *)types[index]) < 0) {
            Py_DECREF(module);
            return NULL;
        }
    }
    if (PyModule_AddIntConstant(module, "INTERFACE", 1) < 0 /* compiled.py compares it */
        || add_construct(module) < 0 || add_socket(module) < 0 || add_ring(module) < 0) {
        Py_DECREF(module);
        return NULL;
    }
    return module;
}
