/* The way of a message out; see `gate.py`. A large one is written into a slot of the ring, see `_broadcast.c`. */

#include "_broadcast.h"
#include "_coder.h"
#include "cpp/include/cortex/broadcast.h"

#include <structmember.h>

enum { UNLOCKED_BYTES = 1 << 17 /* to copy so many takes longer than to let others have the lock meanwhile */ };

static PyObject *dont_wait; /* of ZeroMQ, as an int */

typedef struct {
    PyObject_HEAD
    vectorcallfunc vectorcall;
    Coder *coder;
    PyObject *acquire, *release, *slowly, *retry, *again;
    PyObject *sends; /* a tuple; empty or NULL: every message goes the long way */
    Py_ssize_t limit;
    uint64_t sequence;
    int64_t bytes;
    int64_t refresh_ns;
    PyObject *ring; /* a Broadcast, into whose slots larger bodies go; NULL or None: the long way */
    PyObject *prepare, *large_acquire, *large_release, *finish;
} Gate;

PyDoc_STRVAR(gate_doc,
"Gate(coder, acquire, release, slowly, retry, again, limit)\n--\n\n"
"Called with a message, it sends it; see `gate.py`.\n\n"
"Args:\n"
"    coder: Makes the frames; has a head.\n"
"    acquire: Takes the lock.\n"
"    release: Gives it back.\n"
"    slowly: Called without the lock with a message that has to go the long way.\n"
"    retry: Called with the lock held, a frame, and that of `sends` which had no room for it.\n"
"    again: What that raised.\n"
"    limit: Most bytes of a body.\n");

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
        PyObject *send = PyTuple_GET_ITEM(sends, place), *sent;
        const int found = broadcast_put(send, PyBytes_AS_STRING(frame), PyBytes_GET_SIZE(frame));
        if (found == CORTEX_WRITTEN) continue;
        if (found < 0) {
            PyObject *arguments[3] = {NULL, frame, dont_wait};
            sent = PyObject_Vectorcall(send, arguments + 1, 2 | PY_VECTORCALL_ARGUMENTS_OFFSET, NULL);
            if (sent == NULL && PyErr_ExceptionMatches(gate->again)) PyErr_Clear();
            else if (sent != NULL) {
                Py_DECREF(sent);
                continue;
            } else on_time = -1;
        }
        if (on_time < 0) break;
        sent = PyObject_CallFunction(gate->retry, "OO", frame, send);
        on_time = sent == NULL ? -1 : on_time && sent != Py_False;
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
static int gate_copy(Gate *gate, const Pack *pack) {
    hold_deferred(pack, 1);
    PyObject *released = PyObject_CallNoArgs(gate->release);
    if (released == NULL) {
        hold_deferred(pack, -1);
        return 0;
    }
    Py_DECREF(released);
    Py_BEGIN_ALLOW_THREADS
    copy_deferred(pack);
    Py_END_ALLOW_THREADS
    const int locked = gate_relock(gate);
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    hold_deferred(pack, -1);
    PyErr_Restore(type, value, traceback);
    return locked;
}

/* Write a message into a slot, without the lock while much is copied; 0 if it is not as usual, or with an error set. */
static int gate_write(Gate *gate, PyObject *message, char *memory, Py_ssize_t size, int unlocked, int64_t *stamp_ns) {
    Pack pack;
    if (!write_body(gate->coder, message, &pack, memory, size, 1)) return 0;
    *stamp_ns = pack.stamp_ns;
    if (unlocked) return gate_copy(gate, &pack);
    copy_deferred(&pack);
    return 1;
}

/* Send the header of a written slot; NULL without error if somebody has no room for it. */
static PyObject *gate_commit(Gate *gate, PyObject *slot, Py_ssize_t size, int64_t stamp_ns, int64_t now_ns) {
    char frame[HEADER_SIZE];
    const int number = slot_number(slot);
    const uint64_t rest[5] = {gate->sequence, (uint64_t)stamp_ns, (uint64_t)now_ns, (uint64_t)size, (uint64_t)number};
    memcpy(frame, gate->coder->head, HEAD_SIZE);
    frame[3] = 'S';
    memcpy(frame + HEAD_SIZE, rest, sizeof rest);
    if (broadcast_commit(slot, frame, 1) != CORTEX_WRITTEN) return NULL;
    gate->sequence += 1;
    gate->bytes += size;
    Py_RETURN_TRUE;
}

/* Send a message through a slot, if there is a free one; what has changed while others had the lock is left to `finish`. */
static PyObject *gate_use_slot(Gate *gate, PyObject *ring, PyObject *message, Py_ssize_t size, int unlocked, int64_t now_ns) {
    Py_ssize_t room;
    int64_t stamp_ns;
    PyObject *slot = broadcast_acquire(ring, size), *sent = NULL;
    if (slot == NULL) return NULL;
    if (gate_write(gate, message, slot_memory(slot, ring, &room), size, unlocked, &stamp_ns)) {
        if (ring == gate->ring && gate->refresh_ns != 0 && slot_memory(slot, ring, &room) != NULL)
            sent = gate_commit(gate, slot, size, stamp_ns, now_ns);
        if (sent == NULL)
            sent = PyObject_CallFunction(gate->finish, "OnLL", slot, size, (long long)stamp_ns, (long long)now_ns);
    }
    Py_DECREF(slot);
    return sent;
}

/* Take the lock of large messages if it is free; 0 if not, perhaps with an error set. */
static int gate_lock_large(Gate *gate) {
    PyObject *acquired = PyObject_CallOneArg(gate->large_acquire, Py_False);
    Py_XDECREF(acquired);
    return acquired == Py_True;
}

/* Give the lock of large messages back; keeps the error that is set, if one is. */
static void gate_unlock_large(Gate *gate) {
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    PyObject *released = PyObject_CallNoArgs(gate->large_release);
    if (released == NULL) PyErr_Clear(); /* it was ours */
    Py_XDECREF(released);
    PyErr_Restore(type, value, traceback);
}

/* Write a large message into a slot and send its descriptor, with the lock held; NULL as below.

   While much is copied others may have the lock: then that of large messages keeps other large ones away. */
static PyObject *gate_send_slot(Gate *gate, PyObject *message, Py_ssize_t size, int64_t now_ns) {
    if (gate->ring == NULL || gate->ring == Py_None) return NULL;
    const int unlocked = size >= UNLOCKED_BYTES;
    PyObject *ring = Py_NewRef(gate->ring), *sent = NULL;
    if (!unlocked || gate_lock_large(gate)) {
        sent = gate_use_slot(gate, ring, message, size, unlocked, now_ns);
        if (unlocked) gate_unlock_large(gate);
    }
    Py_DECREF(ring);
    return sent;
}

/* Send with the lock held; NULL without error if the message has to go the long way. */
static PyObject *gate_send(Gate *gate, PyObject *message) {
    const int64_t now_ns = monotonic_ns();
    if (now_ns >= gate->refresh_ns && !gate_prepare(gate, now_ns)) return NULL;
    if (gate->sends == NULL || !PyTuple_CheckExact(gate->sends) || !PyTuple_GET_SIZE(gate->sends)) return NULL;
    const Py_ssize_t size = measure_body(gate->coder, message);
    if (size < 0) return NULL;
    if (size > gate->limit) return gate_send_slot(gate, message, size, now_ns);
    PyObject *frame = make_frame(gate->coder, message, size, gate->sequence, now_ns);
    if (frame == NULL) return NULL;
    gate->sequence += 1;
    gate->bytes += size;
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

PyDoc_STRVAR(gate_send_slot_doc,
"send_slot($self, message, slot, /)\n--\n\n"
"Send a message whose arrays lie where they belong in a slot that is being written, with the lock held.\n\n"
"Returns:\n"
"    As a call; None if it has to go the long way: then the arrays are as they were, and the slot is not given up.\n");

static PyObject *gate_send_slot_method(Gate *gate, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 2)) return NULL;
    PyObject *message = arguments[0], *slot = arguments[1];
    const int64_t now_ns = monotonic_ns();
    if (now_ns >= gate->refresh_ns || gate->ring == NULL || gate->ring == Py_None) Py_RETURN_NONE;
    Py_ssize_t room;
    char *memory = slot_memory(slot, gate->ring, &room);
    const Py_ssize_t size = memory == NULL ? -1 : measure_in_place(gate->coder, message, memory, room);
    Pack pack;
    if (size <= gate->limit || !write_body(gate->coder, message, &pack, memory, size, 0)) return none_or_error(NULL);
    PyObject *sent = gate_commit(gate, slot, size, pack.stamp_ns, now_ns);
    return sent != NULL ? sent : none_or_error(NULL);
}

static PyMethodDef gate_methods[] = {
    {"send_slot", (PyCFunction)(void (*)(void))gate_send_slot_method, METH_FASTCALL, gate_send_slot_doc},
    {NULL, NULL, 0, NULL},
};

static PyObject *gate_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"coder", "acquire", "release", "slowly", "retry", "again", "limit", NULL};
    PyObject *coder, *acquire, *release, *slowly, *retry, *again;
    Py_ssize_t limit;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "O!OOOOOn:Gate", names, &CoderType, &coder, &acquire, &release,
                                     &slowly, &retry, &again, &limit))
        return NULL;
    Gate *gate = (Gate *)type->tp_alloc(type, 0);
    if (gate == NULL) return NULL;
    gate->vectorcall = gate_call;
    gate->coder = (Coder *)Py_NewRef(coder);
    gate->acquire = Py_NewRef(acquire);
    gate->release = Py_NewRef(release);
    gate->slowly = Py_NewRef(slowly);
    gate->retry = Py_NewRef(retry);
    gate->again = Py_NewRef(again);
    gate->limit = limit;
    return (PyObject *)gate;
}

static int gate_traverse(Gate *gate, visitproc visit, void *arg) {
    Py_VISIT(gate->coder);
    Py_VISIT(gate->acquire);
    Py_VISIT(gate->release);
    Py_VISIT(gate->slowly);
    Py_VISIT(gate->retry);
    Py_VISIT(gate->again);
    Py_VISIT(gate->sends);
    Py_VISIT(gate->ring);
    Py_VISIT(gate->prepare);
    Py_VISIT(gate->large_acquire);
    Py_VISIT(gate->large_release);
    Py_VISIT(gate->finish);
    return 0;
}

static int gate_clear(Gate *gate) {
    Py_CLEAR(gate->coder);
    Py_CLEAR(gate->acquire);
    Py_CLEAR(gate->release);
    Py_CLEAR(gate->slowly);
    Py_CLEAR(gate->retry);
    Py_CLEAR(gate->again);
    Py_CLEAR(gate->sends);
    Py_CLEAR(gate->ring);
    Py_CLEAR(gate->prepare);
    Py_CLEAR(gate->large_acquire);
    Py_CLEAR(gate->large_release);
    Py_CLEAR(gate->finish);
    return 0;
}

static void gate_dealloc(Gate *gate) {
    PyObject_GC_UnTrack(gate);
    gate_clear(gate);
    Py_TYPE(gate)->tp_free((PyObject *)gate);
}

static PyMemberDef gate_members[] = {
    {"sends", T_OBJECT, offsetof(Gate, sends), 0, "Take a frame and flags; none: every message goes the long way."},
    {"ring", T_OBJECT, offsetof(Gate, ring), 0, "A `Broadcast`, into whose slots larger bodies go; None: the long way."},
    {"prepare", T_OBJECT, offsetof(Gate, prepare), 0, "Called with the lock held and the time when `refresh_ns` is over."},
    {"large_acquire", T_OBJECT, offsetof(Gate, large_acquire), 0, "Called with False, takes the lock of large messages."},
    {"large_release", T_OBJECT, offsetof(Gate, large_release), 0, "Gives it back."},
    {"finish", T_OBJECT, offsetof(Gate, finish), 0, "Sends a written slot: slot, size, stamp_ns, publish_ns."},
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
    .tp_methods = gate_methods,
};

int add_gate(PyObject *module) {
    dont_wait = PyLong_FromLong(1);
    return dont_wait == NULL ? -1 : PyModule_AddType(module, &GateType);
}
