/* A publisher's end of its ring, for Python; what it does is in `broadcast.h`, which C++ uses, too. */

#include "_broadcast.h"

#include "_numpy.h"
#include "cpp/include/cortex/broadcast.h"

#include <structmember.h>

enum { RING_BYTES = 1 << 19 };

typedef struct {
    PyObject_HEAD
    CortexWriter writer;
    PyObject *again;
    PyObject *memory; /* a `SlotMemory` of the ring in use, or NULL */
    int open;
} Broadcast;

static PyTypeObject BroadcastType;

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
    unsigned int timeout_ms;
    unsigned long long first;
    if (!PyArg_ParseTuple(arguments, "iiipIK:add", &hello.socket, &hello.page, &hello.wakeup, &strict, &timeout_ms, &first)
        || !cast_is_open(cast))
        return NULL;
    const int member = cortex_writer_add(&cast->writer, &hello, strict, timeout_ms, first);
    return member < 0 ? PyErr_SetFromErrno(PyExc_OSError) : PyLong_FromLong(member);
}

static PyObject *cast_remove(Broadcast *cast, PyObject *number) {
    const long member = PyLong_AsLong(number);
    if ((member == -1 && PyErr_Occurred()) || !cast_is_open(cast)) return NULL;
    if (member < 0 || member >= cast->writer.count || !cast->writer.members[member].used || cast->writer.members[member].left)
        return PyErr_Format(PyExc_IndexError, "no member %ld", member);
    cortex_writer_remove(&cast->writer, (int)member);
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

/* The ring whose `send` this is; NULL if it is something else, or closed. */
static CortexWriter *writer_of(PyObject *send) {
    if (!PyCFunction_CheckExact(send)) return NULL;
    PyObject *self = PyCFunction_GET_SELF(send);
    return self != NULL && Py_IS_TYPE(self, &BroadcastType) && ((Broadcast *)self)->open ? &((Broadcast *)self)->writer : NULL;
}

int broadcast_is_open(PyObject *send) { return writer_of(send) != NULL; }

int broadcast_put(PyObject *send, const char *frame, Py_ssize_t size) {
    CortexWriter *writer = writer_of(send);
    return writer == NULL ? -1 : cortex_writer_put(writer, frame, (size_t)size, 1);
}

char *broadcast_begin(PyObject *send, Py_ssize_t size) {
    CortexWriter *writer = writer_of(send);
    uint8_t *place = NULL;
    if (writer != NULL) cortex_writer_begin(writer, (size_t)size, 1, &place);
    return (char *)place;
}

void broadcast_finish(PyObject *send, Py_ssize_t size) { cortex_writer_finish(writer_of(send), (size_t)size); }

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

static PyObject *cast_patience(Broadcast *cast, PyObject *size) {
    const uint64_t bytes = PyLong_AsUnsignedLongLong(size);
    if (PyErr_Occurred() || !cast_is_open(cast)) return NULL;
    return PyLong_FromLongLong(cortex_writer_patience(&cast->writer, bytes));
}

static PyObject *cast_give_up(Broadcast *cast, PyObject *arguments) {
    unsigned long long size;
    long long waited_ms;
    if (!PyArg_ParseTuple(arguments, "KL:give_up", &size, &waited_ms) || !cast_is_open(cast)) return NULL;
    cortex_writer_give_up(&cast->writer, size, waited_ms);
    Py_RETURN_NONE;
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
    int lagging = 0;
    if ((uint64_t)size > cast->writer.map->slot_bytes || (!cortex_writer_look(&cast->writer, &lagging) && lagging)) return NULL;
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

int broadcast_commit(PyObject *object, const char *frame, int all_or_none) {
    Slot *slot = (Slot *)object;
    uint64_t sequence;
    memcpy(&sequence, frame + HEAD_SIZE, sizeof sequence);
    const int found = cortex_slot_commit(&slot->cast->writer, slot->number, sequence, frame, HEADER_SIZE, all_or_none);
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
    unsigned long long size;
    int exact, deep;
    if (!PyArg_ParseTuple(arguments, "Kpp:provide", &size, &exact, &deep) || !cast_is_open(cast)) return NULL;
    if (cortex_writer_provide(&cast->writer, size, exact, deep) < 0) return PyErr_SetFromErrno(PyExc_OSError);
    if (cast->memory != NULL && ((SlotMemory *)cast->memory)->map != cast->writer.map) Py_CLEAR(cast->memory);
    Py_RETURN_NONE;
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

static PyMethodDef cast_methods[] = {
    {"add", (PyCFunction)cast_add, METH_VARARGS, "Take in a reader by the descriptors of its hello, which become ours; its number."},
    {"remove", (PyCFunction)cast_remove, METH_O, "Forget a reader."},
    {"send", (PyCFunction)(void (*)(void))cast_send, METH_FASTCALL,
     "Send a frame to all; `again` if a reliable reader has no room, False if one is lagging and loses it."},
    {"end", (PyCFunction)cast_end, METH_O, "Send the last frame, for which there is room."},
    {"dissolve", (PyCFunction)cast_dissolve, METH_NOARGS, "Send all readers another way, and close it; what is in it stays theirs."},
    {"patience", (PyCFunction)cast_patience, METH_O,
     "The shortest time that a reliable reader without room for so many bytes (0: one that has not come to all slots) may take [ms]; -1: all have."},
    {"give_up", (PyCFunction)cast_give_up, METH_VARARGS, "Wait for those no more whose time is up to so many ms, until they have read half."},
    {"provide", (PyCFunction)cast_provide, METH_VARARGS, "Have slots for bodies of a size: whether all have it, whether a reader keeps many; OSError: no memory."},
    {"acquire", (PyCFunction)cast_acquire, METH_O, "A slot for so many bytes; None: none is free, or they are too small."},
    {"commit", (PyCFunction)(void (*)(void))cast_commit, METH_FASTCALL, "Send the frame of a slot that has been written, as `send`."},
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
    return Py_BuildValue("KKii", (unsigned long long)hello.source, (unsigned long long)hello.reader, hello.page, hello.wakeup);
}

static PyMethodDef functions[] = {
    {"listen", listen_at, METH_O, "Listen at a path for readers; the descriptor."},
    {"accept", accept_one, METH_O, "The descriptor of a connection, -1 if there is none."},
    {"hear", hear, METH_O, "Source, number, page and wakeup of who has connected; BlockingIOError: nothing said yet."},
    {NULL, NULL, 0, NULL},
};

int add_broadcast(PyObject *module) {
    if (PyModule_AddFunctions(module, functions) < 0) return -1;
    if (PyType_Ready(&SlotMemoryType) < 0 || PyType_Ready(&SlotType) < 0) return -1;
    return PyModule_AddType(module, &BroadcastType);
}
