/* A publisher's ring of frames and its readers, for Python; what they do is in `broadcast.h`, which C++ uses, too. */

#include "_broadcast.h"

#include "_numpy.h"
#include "cpp/include/cortex/broadcast.h"

#include <poll.h>
#include <structmember.h>

enum { RING_BYTES = 1 << 19 };
static const uint64_t PRIVATE_BYTES = 64 << 20; /* most that a reader copies of what it may lease no more */

static PyObject *dont_wait, *no_flags; /* of ZeroMQ, as ints */

typedef struct {
    PyObject_HEAD
    CortexWriter writer;
    PyObject *again;
    PyObject *memory; /* a `SlotMemory` of the ring in use, or NULL */
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
    Py_XDECREF(cast->memory);
    Py_TYPE(cast)->tp_free((PyObject *)cast);
}

static PyObject *cast_close(Broadcast *cast, PyObject *unused) {
    (void)unused;
    if (cast->open) cortex_writer_close(&cast->writer);
    cast->open = 0;
    Py_CLEAR(cast->memory);
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
    if (member >= 0 && member < cast->writer.count && cast->writer.members[member].used && !cast->writer.members[member].left)
        return &cast->writer.members[member];
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

static PyObject *cast_dissolve(Broadcast *cast, PyObject *unused) {
    (void)unused;
    if (!cast_is_open(cast)) return NULL;
    cortex_writer_dissolve(&cast->writer);
    return cast_close(cast, NULL);
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

/* Slots */

/* Where the bodies of a ring lie, for who has to tell a device about it. */
typedef struct {
    PyObject_HEAD
    CortexMap *map;
} SlotMemory;

static int memory_buffer(SlotMemory *memory, Py_buffer *view, int flags) {
    const CortexMap *map = memory->map;
    return PyBuffer_FillInfo(view, (PyObject *)memory, map->slots, (Py_ssize_t)(map->slot_count * map->slot_bytes), 0, flags);
}

static void memory_dealloc(SlotMemory *memory) {
    cortex_map_end(memory->map);
    Py_TYPE(memory)->tp_free((PyObject *)memory);
}

static PyBufferProcs memory_as_buffer = {(getbufferproc)memory_buffer, NULL};

static PyTypeObject SlotMemoryType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.SlotMemory",
    .tp_doc = "All slots of a ring, mapped as long as this is kept.",
    .tp_basicsize = sizeof(SlotMemory),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .tp_dealloc = (destructor)memory_dealloc,
    .tp_as_buffer = &memory_as_buffer,
};

/* A slot that is being written; it is free again when the last array that looks at it is gone. */
typedef struct {
    PyObject_HEAD
    Broadcast *cast;
    SlotMemory *memory;
    PyObject *on_forgotten; /* called if it ends neither sent nor released; NULL or None: nothing is */
    int number, open;
} Slot;

static PyTypeObject SlotType;

static int slot_is_current(const Slot *slot) {
    return slot->open && slot->cast->open && slot->cast->writer.map == slot->memory->map;
}

static PyObject *slot_release(Slot *slot, PyObject *unused) {
    (void)unused;
    if (slot_is_current(slot)) cortex_slot_abandon(&slot->cast->writer, slot->number);
    slot->open = 0;
    Py_RETURN_NONE;
}

static void slot_dealloc(Slot *slot) {
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    if (slot->open && slot->on_forgotten != NULL && slot->on_forgotten != Py_None) {
        PyObject *called = PyObject_CallNoArgs(slot->on_forgotten);
        if (called == NULL) PyErr_WriteUnraisable(slot->on_forgotten);
        Py_XDECREF(called);
    }
    Py_DECREF(slot_release(slot, NULL));
    PyErr_Restore(type, value, traceback);
    Py_XDECREF(slot->on_forgotten);
    Py_DECREF(slot->cast);
    Py_DECREF(slot->memory);
    Py_TYPE(slot)->tp_free((PyObject *)slot);
}

static int slot_buffer(Slot *slot, Py_buffer *view, int flags) {
    const CortexMap *map = slot->memory->map;
    return PyBuffer_FillInfo(view, (PyObject *)slot, cortex_slot_memory(map, slot->number), (Py_ssize_t)map->slot_bytes, 0, flags);
}

static PyObject *slot_current(Slot *slot, void *unused) { return (void)unused, PyBool_FromLong(slot_is_current(slot)); }

static PyBufferProcs slot_as_buffer = {(getbufferproc)slot_buffer, NULL};

static PyMemberDef slot_members[] = {
    {"number", T_INT, offsetof(Slot, number), READONLY, "Its number."},
    {"memory", T_OBJECT, offsetof(Slot, memory), READONLY, "All slots of its ring."},
    {"on_forgotten", T_OBJECT, offsetof(Slot, on_forgotten), 0, "Called if it ends neither sent nor released, anywhere; or None."},
    {NULL, 0, 0, 0, NULL},
};

static PyGetSetDef slot_properties[] = {
    {"is_current", (getter)slot_current, NULL, "Whether it can be sent: its ring is in use, and it is not sent or released yet.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyMethodDef slot_methods[] = {
    {"release", (PyCFunction)slot_release, METH_NOARGS, "Give it back unsent."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject SlotType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Slot",
    .tp_doc = "A slot that is being written; given back when it and all arrays that look at it are gone.",
    .tp_basicsize = sizeof(Slot),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .tp_dealloc = (destructor)slot_dealloc,
    .tp_as_buffer = &slot_as_buffer,
    .tp_members = slot_members,
    .tp_getset = slot_properties,
    .tp_methods = slot_methods,
};

static PyObject *cast_memory(Broadcast *cast) {
    if (cast->memory != NULL && ((SlotMemory *)cast->memory)->map == cast->writer.map) return cast->memory;
    SlotMemory *memory = (SlotMemory *)SlotMemoryType.tp_alloc(&SlotMemoryType, 0);
    if (memory == NULL) return NULL;
    memory->map = cast->writer.map;
    __atomic_fetch_add(&memory->map->users, 1, __ATOMIC_RELAXED);
    Py_XSETREF(cast->memory, (PyObject *)memory);
    return cast->memory;
}

PyObject *broadcast_acquire(PyObject *object, Py_ssize_t size) {
    if (object == NULL || !Py_IS_TYPE(object, &BroadcastType) || !((Broadcast *)object)->open) return NULL;
    Broadcast *cast = (Broadcast *)object;
    int late = 0;
    if ((uint64_t)size > cast->writer.map->slot_bytes || (!cortex_writer_look(&cast->writer, &late) && late)) return NULL;
    const int number = cortex_slot_acquire(&cast->writer);
    PyObject *memory = number < 0 ? NULL : cast_memory(cast);
    Slot *slot = memory == NULL ? NULL : (Slot *)SlotType.tp_alloc(&SlotType, 0);
    if (slot == NULL) {
        if (number >= 0) cortex_slot_abandon(&cast->writer, number);
        return NULL;
    }
    slot->cast = (Broadcast *)Py_NewRef(cast);
    slot->memory = (SlotMemory *)Py_NewRef(memory);
    slot->number = number;
    slot->open = 1;
    return (PyObject *)slot;
}

char *slot_memory(PyObject *object, PyObject *cast, Py_ssize_t *bytes) {
    if (!Py_IS_TYPE(object, &SlotType) || (PyObject *)((Slot *)object)->cast != cast || !slot_is_current((Slot *)object))
        return NULL;
    const Slot *slot = (const Slot *)object;
    *bytes = (Py_ssize_t)slot->memory->map->slot_bytes;
    return (char *)cortex_slot_memory(slot->memory->map, slot->number);
}

int slot_number(PyObject *slot) { return ((Slot *)slot)->number; }

int broadcast_commit(PyObject *object, const char *frame, int mind) {
    Slot *slot = (Slot *)object;
    uint64_t sequence;
    memcpy(&sequence, frame + HEAD_SIZE, sizeof sequence);
    const int found = cortex_slot_commit(&slot->cast->writer, slot->number, sequence, frame, HEADER_SIZE, mind);
    if (found != CORTEX_FULL) slot->open = 0;
    return found;
}

static PyObject *cast_acquire(Broadcast *cast, PyObject *size) {
    const Py_ssize_t bytes = PyLong_AsSsize_t(size);
    if ((bytes == -1 && PyErr_Occurred()) || !cast_is_open(cast)) return NULL;
    PyObject *slot = broadcast_acquire((PyObject *)cast, bytes);
    return slot == NULL ? none_or_error(NULL) : slot;
}

static PyObject *cast_commit(Broadcast *cast, PyObject *const *arguments, Py_ssize_t count) {
    Py_ssize_t bytes;
    if (!arguments_are(count, 2) || !cast_is_open(cast)) return NULL;
    if (!PyBytes_CheckExact(arguments[1]) || PyBytes_GET_SIZE(arguments[1]) != HEADER_SIZE
        || slot_memory(arguments[0], (PyObject *)cast, &bytes) == NULL) {
        PyErr_SetString(PyExc_ValueError, "expected a slot that is being written, and a header as bytes");
        return NULL;
    }
    const int found = broadcast_commit(arguments[0], PyBytes_AS_STRING(arguments[1]), 0);
    if (found != CORTEX_FULL) return PyBool_FromLong(found == CORTEX_WRITTEN);
    PyErr_SetNone(cast->again);
    return NULL;
}

static PyObject *cast_provide(Broadcast *cast, PyObject *arguments) {
    unsigned long long slots, slot_bytes;
    if (!PyArg_ParseTuple(arguments, "KK:provide", &slots, &slot_bytes) || !cast_is_open(cast)) return NULL;
    if (cortex_writer_grow(&cast->writer, cast->writer.capacity, slots, slot_bytes) < 0) return PyErr_SetFromErrno(PyExc_OSError);
    Py_CLEAR(cast->memory);
    Py_RETURN_NONE;
}

static PyObject *cast_behind(Broadcast *cast, PyObject *unused) {
    (void)unused;
    if (!cast_is_open(cast)) return NULL;
    PyObject *found = PyList_New(0);
    for (int index = 0; found != NULL && index < cast->writer.count; ++index) {
        if (!cortex_member_is_behind(&cast->writer, &cast->writer.members[index])) continue;
        PyObject *number = PyLong_FromLong(index);
        if (number == NULL || PyList_Append(found, number) < 0) Py_CLEAR(found);
        Py_XDECREF(number);
    }
    return found;
}

static PyObject *cast_leased(Broadcast *cast, PyObject *unused) {
    (void)unused;
    if (!cast_is_open(cast)) return NULL;
    cortex_writer_tidy(&cast->writer);
    long leased = 0;
    for (int slot = 0; slot < (int)cast->writer.map->slot_count; ++slot) leased += cortex_slot_is_wanted(&cast->writer, slot);
    return PyLong_FromLong(leased);
}

static PyObject *cast_slots(Broadcast *cast, void *unused) {
    (void)unused;
    const CortexMap *map = cast->open ? cast->writer.map : NULL;
    return PyLong_FromUnsignedLongLong(map == NULL ? 0 : map->slot_count);
}

static PyObject *cast_slot_bytes(Broadcast *cast, void *unused) {
    (void)unused;
    const CortexMap *map = cast->open ? cast->writer.map : NULL;
    return PyLong_FromUnsignedLongLong(map == NULL ? 0 : map->slot_bytes);
}

static PyGetSetDef cast_properties[] = {
    {"slots", (getter)cast_slots, NULL, "How many slots there are.", NULL},
    {"slot_bytes", (getter)cast_slot_bytes, NULL, "Size of a slot.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyObject *cast_give_up(Broadcast *cast, PyObject *number) {
    CortexMember *member = cast_member(cast, number);
    if (member == NULL) return NULL;
    cortex_member_give_up(&cast->writer, member);
    Py_RETURN_NONE;
}

static PyMethodDef cast_methods[] = {
    {"add", (PyCFunction)cast_add, METH_VARARGS, "Take in a reader by the descriptors of its hello, which become ours; its number."},
    {"remove", (PyCFunction)cast_remove, METH_O, "Forget a reader."},
    {"send", (PyCFunction)(void (*)(void))cast_send, METH_FASTCALL,
     "Send a frame to all; `again` if a reliable reader has no room, False if one is late and loses it."},
    {"end", (PyCFunction)cast_end, METH_O, "Send the last frame, for which there is room."},
    {"dissolve", (PyCFunction)cast_dissolve, METH_NOARGS, "Send all readers another way, and close it; what is in it stays theirs."},
    {"in_the_way", (PyCFunction)cast_in_the_way, METH_O, "The reliable readers that have no room for so many bytes."},
    {"give_up", (PyCFunction)cast_give_up, METH_O, "Wait for a reader no more, until it has read half."},
    {"provide", (PyCFunction)cast_provide, METH_VARARGS, "Go on in a ring with so many slots of so many bytes, a multiple of 4096."},
    {"acquire", (PyCFunction)cast_acquire, METH_O, "A slot for so many bytes; None: none is free, or they are too small."},
    {"commit", (PyCFunction)(void (*)(void))cast_commit, METH_FASTCALL, "Send the frame of a slot that has been written, as `send`."},
    {"behind", (PyCFunction)cast_behind, METH_NOARGS, "The reliable readers that have not come to all slots."},
    {"leased", (PyCFunction)cast_leased, METH_NOARGS, "How many slots somebody looks at, or will."},
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
    .tp_getset = cast_properties,
};

/* The subscriber's end */

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
    CortexLease lease; /* of a copy only the seat, where its bytes are counted */
    char *data;
    Py_ssize_t size;
    int is_leased;
} Body;

static void body_dealloc(Body *body) {
    if (body->is_leased) {
        cortex_lease_end(&body->lease);
    } else if (body->data != NULL) {
        __atomic_fetch_sub(&body->lease.seat->private_bytes, (uint64_t)body->size, __ATOMIC_RELAXED);
        cortex_seat_end(body->lease.seat);
        PyMem_Free(body->data);
    }
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

/* Copy a message that may not be leased: CORTEX_COPY; CORTEX_FULL if too much is kept already; -1 with an error set. */
static int copy_slot(RingReader *reader, Body *body, uint64_t sequence) {
    CortexSeat *seat = reader->ring.seat;
    const uint64_t size = (uint64_t)body->size;
    if (seat->private_bytes + size > (size < PRIVATE_BYTES / 4 ? PRIVATE_BYTES : 4 * size)) return CORTEX_FULL;
    body->data = PyMem_Malloc((size_t)size);
    if (body->data == NULL) return PyErr_NoMemory(), -1;
    body->lease.seat = seat;
    __atomic_fetch_add(&seat->users, 1, __ATOMIC_RELAXED);
    __atomic_fetch_add(&seat->private_bytes, size, __ATOMIC_RELAXED);
    memcpy(body->data, cortex_slot_memory(reader->ring.map, (int)body->lease.slot), (size_t)size);
    return cortex_reader_has(&reader->ring, body->lease.slot, sequence) ? CORTEX_COPY : CORTEX_OVERWRITTEN;
}

/* Take the body that a frame names into `reader->body`; 0 if the message is lost, 1 if it is there or the frame is wrong, -1
   if it has to wait or with an error set. */
static int take_slot(RingReader *reader, const char *frame) {
    uint64_t rest[5];
    memcpy(rest, frame + HEAD_SIZE, sizeof rest);
    const uint64_t sequence = rest[0], size = rest[3], slot = rest[4];
    Body *body = (Body *)BodyType.tp_alloc(&BodyType, 0);
    if (body == NULL) return -1;
    int found = cortex_reader_lease(&reader->ring, slot, sequence, size, &body->lease);
    body->size = (Py_ssize_t)size;
    body->is_leased = found == CORTEX_LEASED;
    if (body->is_leased) body->data = (char *)cortex_slot_memory(body->lease.map, (int)slot);
    if (found == CORTEX_COPY) {
        found = copy_slot(reader, body, sequence);
        reader->is_crowded = found == CORTEX_FULL;
    }
    if (found == CORTEX_LEASED || found == CORTEX_COPY) {
        reader->body = (PyObject *)body;
        return 1;
    }
    Py_DECREF(body);
    return found < 0 || reader->is_crowded ? -1 : found == CORTEX_NO_SLOT;
}

/* The next frame as bytes; NULL if there is none, perhaps with an error. Then the bell rings when one comes. */
static PyObject *next_frame(RingReader *reader) {
    const uint8_t *data;
    int64_t size;
    Py_CLEAR(reader->body);
    reader->is_crowded = 0;
    if (!reader->open || reader->ring.ring == NULL) return NULL;
    while ((size = cortex_reader_peek(&reader->ring, &data)) > 0) {
        PyObject *frame = PyBytes_FromStringAndSize((const char *)data, (Py_ssize_t)size);
        if (frame == NULL) return NULL;
        int found = cortex_reader_is_whole(&reader->ring);
        if (found && size == HEADER_SIZE && PyBytes_AS_STRING(frame)[3] == 'S') {
            found = take_slot(reader, PyBytes_AS_STRING(frame));
            if (found >= 0) cortex_reader_move(&reader->ring, reader->ring.tail + cortex_entry_bytes((uint64_t)size));
        } else if (found) {
            found = cortex_reader_take(&reader->ring, size);
        }
        if (found > 0) {
            cortex_reader_disarm(&reader->ring);
            return frame;
        }
        Py_DECREF(frame);
        if (found < 0) return NULL;
    }
    if (size == 0 || reader->told) return NULL;
    reader->told = 1;
    return PyBytes_FromStringAndSize(NULL, 0); /* no frame: the link sees why */
}

PyObject *reader_body(PyObject *object, const char **data, Py_ssize_t *size) {
    if (object == NULL || !Py_IS_TYPE(object, &RingReaderType)) return NULL;
    RingReader *reader = (RingReader *)object;
    if (reader->body == NULL) return NULL;
    *data = ((Body *)reader->body)->data;
    *size = ((Body *)reader->body)->size;
    return reader->body;
}

void reader_body_taken(PyObject *reader) { Py_CLEAR(((RingReader *)reader)->body); }

static PyObject *reader_take_body(RingReader *reader, PyObject *unused) {
    (void)unused;
    PyObject *body = reader->body;
    reader->body = NULL;
    if (body == NULL) Py_RETURN_NONE;
    npy_intp shape = (npy_intp)((Body *)body)->size;
    PyObject *array = PyArray_New(&PyArray_Type, 1, &shape, NPY_UINT8, NULL, ((Body *)body)->data, 0, 0, NULL);
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

/* As `next_frame`, with the bell armed if there is none. */
static PyObject *next_or_arm(RingReader *reader) {
    while (1) {
        PyObject *frame = next_frame(reader);
        if (frame != NULL || PyErr_Occurred() || !reader->open || reader->ring.ring == NULL || reader->ring.state != CORTEX_SOUND || reader->is_crowded
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
    if (reader->is_crowded) cortex_reader_move(&reader->ring, reader->ring.tail + cortex_entry_bytes(HEADER_SIZE));
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

static PyObject *reader_fd(RingReader *reader, void *unused) {
    (void)unused;
    return PyLong_FromLong(reader->ring.bell);
}

static PyObject *reader_is_crowded(RingReader *reader, void *unused) {
    (void)unused;
    return PyBool_FromLong(reader->is_crowded);
}

static PyGetSetDef reader_properties[] = {
    {"is_crowded", (getter)reader_is_crowded, NULL, "Whether the next message waits, as too many large ones are kept.", NULL},
    {"broken", (getter)reader_broken, NULL, "Whether there is something in the ring that is no frame.", NULL},
    {"ended", (getter)reader_ended, NULL, "Whether all that follows comes another way.", NULL},
    {"fd", (getter)reader_fd, NULL, "Becomes readable when a frame comes after none was there.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
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
    if (PyType_Ready(&SlotMemoryType) < 0 || PyType_Ready(&SlotType) < 0 || PyType_Ready(&BodyType) < 0) return -1;
    return PyModule_AddType(module, &BroadcastType) < 0 ? -1 : PyModule_AddType(module, &RingReaderType);
}
