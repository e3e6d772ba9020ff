/* The way of a message out; see `fast_send.py`. A large one is written into a slot of the ring, see `_broadcast.c`. */

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
    union {
        struct {
            PyObject *acquire, *release, *locked, *slowly, *retry, *again;
            PyObject *sends; /* a tuple; empty or NULL: every message takes the slow path */
            PyObject *ring;  /* a Broadcast, into whose slots larger bodies go; NULL or None: the slow path */
            PyObject *prepare, *large_acquire, *large_release, *finish;
        };
        PyObject *held[12];
    };
    Py_ssize_t limit;
    uint64_t sequence;
    int64_t bytes;
    int64_t refresh_ns;
} FastSend;

PyDoc_STRVAR(fast_doc,
"FastSend(coder, acquire, release, locked, slowly, retry, again, limit)\n--\n\n"
"Called with a message, it sends it; see `fast_send.py`.\n\n"
"Args:\n"
"    coder: Makes the frames; has a head.\n"
"    acquire: Takes the lock.\n"
"    release: Gives it back.\n"
"    locked: Whether somebody has it.\n"
"    slowly: Called without the lock with a message that has to take the slow path.\n"
"    retry: Called with the lock held, a frame, and that of `sends` which had no room for it.\n"
"    again: What that raised.\n"
"    limit: Most bytes of a body.\n");

/* See who has come and gone, now and then; 0 with an error set, or if nobody is there to do it. */
static int fast_prepare(FastSend *fast, int64_t now_ns) {
    if (fast->prepare == NULL) return 0;
    PyObject *prepared = PyObject_CallFunction(fast->prepare, "L", (long long)now_ns);
    Py_XDECREF(prepared);
    return prepared != NULL;
}

/* Send a frame to all; the lock is held. */
static PyObject *fast_send_frame(FastSend *fast, PyObject *frame) {
    PyObject *sends = Py_NewRef(fast->sends); /* who comes or goes meanwhile replaces it */
    int on_time = 1;
    for (Py_ssize_t place = 0; on_time >= 0 && place < PyTuple_GET_SIZE(sends); ++place) {
        PyObject *send = PyTuple_GET_ITEM(sends, place), *sent;
        const int found = broadcast_put(send, PyBytes_AS_STRING(frame), PyBytes_GET_SIZE(frame));
        if (found == CORTEX_WRITTEN) continue;
        if (found < 0) {
            PyObject *arguments[3] = {NULL, frame, dont_wait};
            sent = PyObject_Vectorcall(send, arguments + 1, 2 | PY_VECTORCALL_ARGUMENTS_OFFSET, NULL);
            if (sent == NULL && PyErr_ExceptionMatches(fast->again)) PyErr_Clear();
            else if (sent != NULL) {
                Py_DECREF(sent);
                continue;
            } else on_time = -1;
        }
        if (on_time < 0) break;
        sent = PyObject_CallFunction(fast->retry, "OO", frame, send);
        on_time = sent == NULL ? -1 : on_time && sent != Py_False;
        Py_XDECREF(sent);
    }
    Py_DECREF(sends);
    return on_time < 0 ? NULL : PyBool_FromLong(on_time);
}

/* Whether all that is to be done is to write into the ring. */
static int fast_has_ring_only(const FastSend *fast) {
    return fast->sends != NULL && PyTuple_CheckExact(fast->sends) && PyTuple_GET_SIZE(fast->sends) == 1
        && broadcast_is_open(PyTuple_GET_ITEM(fast->sends, 0));
}

/* Write a small message there; 0 if it has to be sent as bytes, or is not as usual. */
static int fast_write_frame(FastSend *fast, PyObject *message, Py_ssize_t size, int64_t now_ns) {
    PyObject *send = PyTuple_GET_ITEM(fast->sends, 0);
    char *place = broadcast_begin(send, HEADER_SIZE + size);
    if (place == NULL || !write_frame(fast->coder, message, place, size, fast->sequence, now_ns)) return 0;
    broadcast_finish(send, HEADER_SIZE + size);
    fast->sequence += 1;
    fast->bytes += size;
    return 1;
}

/* Send a small message through the ring without the lock, if nobody has it: others need the GIL to take it, which is kept
   here, as no Python code runs; 0 if there is more to do. */
static int fast_send_unlocked(FastSend *fast, PyObject *message) {
    const int64_t now_ns = monotonic_ns();
    if (now_ns >= fast->refresh_ns || !fast_has_ring_only(fast)) return 0;
    const Py_ssize_t size = is_free(fast->locked) ? measure_body(fast->coder, message) : -1;
    return size >= 0 && size <= fast->limit && fast_write_frame(fast, message, size, now_ns);
}

/* Take the lock back, whatever signals come; 0 with an error set if one of their handlers raised. */
static int fast_relock(FastSend *fast) {
    PyObject *acquired, *type = NULL, *value = NULL, *traceback = NULL;
    while ((acquired = PyObject_CallNoArgs(fast->acquire)) == NULL) {
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
static int fast_copy(FastSend *fast, const Pack *pack) {
    hold_deferred(pack, 1);
    PyObject *released = PyObject_CallNoArgs(fast->release);
    if (released == NULL) {
        hold_deferred(pack, -1);
        return 0;
    }
    Py_DECREF(released);
    Py_BEGIN_ALLOW_THREADS
    copy_deferred(pack);
    Py_END_ALLOW_THREADS
    const int locked = fast_relock(fast);
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    hold_deferred(pack, -1);
    PyErr_Restore(type, value, traceback);
    return locked;
}

/* Write a message into a slot, without the lock while much is copied; 0 if it is not as usual, or with an error set. */
static int fast_write(FastSend *fast, PyObject *message, char *memory, Py_ssize_t size, int unlocked, int64_t *stamp_ns) {
    Pack pack;
    if (!write_body(fast->coder, message, &pack, memory, size, 1)) return 0;
    *stamp_ns = pack.stamp_ns;
    if (unlocked) return fast_copy(fast, &pack);
    copy_deferred(&pack);
    return 1;
}

/* Send the header of a written slot; NULL without error if somebody has no room for it. */
static PyObject *fast_commit(FastSend *fast, PyObject *slot, Py_ssize_t size, int64_t stamp_ns, int64_t now_ns) {
    char frame[HEADER_SIZE];
    const int number = slot_number(slot);
    const uint64_t rest[5] = {fast->sequence, (uint64_t)stamp_ns, (uint64_t)now_ns, (uint64_t)size, (uint64_t)number};
    memcpy(frame, fast->coder->head, HEAD_SIZE);
    frame[3] = 'S';
    memcpy(frame + HEAD_SIZE, rest, sizeof rest);
    if (broadcast_commit(slot, frame, 1) != CORTEX_WRITTEN) return NULL;
    fast->sequence += 1;
    fast->bytes += size;
    Py_RETURN_TRUE;
}

/* Send a message through a slot, if there is a free one; what has changed while others had the lock is left to `finish`. */
static PyObject *fast_use_slot(FastSend *fast, PyObject *ring, PyObject *message, Py_ssize_t size, int unlocked, int64_t now_ns) {
    Py_ssize_t room;
    int64_t stamp_ns;
    PyObject *slot = broadcast_acquire(ring, size), *sent = NULL;
    if (slot == NULL) return NULL;
    if (fast_write(fast, message, slot_memory(slot, ring, &room), size, unlocked, &stamp_ns)) {
        if (ring == fast->ring && fast->refresh_ns != 0 && slot_memory(slot, ring, &room) != NULL)
            sent = fast_commit(fast, slot, size, stamp_ns, now_ns);
        if (sent == NULL)
            sent = PyObject_CallFunction(fast->finish, "OnLL", slot, size, (long long)stamp_ns, (long long)now_ns);
    }
    Py_DECREF(slot);
    return sent;
}

/* Take the lock of large messages if it is free; 0 if not, perhaps with an error set. */
static int fast_lock_large(FastSend *fast) {
    PyObject *acquired = PyObject_CallOneArg(fast->large_acquire, Py_False);
    Py_XDECREF(acquired);
    return acquired == Py_True;
}

/* Write a large message into a slot and send its descriptor, with the lock held; NULL as below.

   While much is copied others may have the lock: then that of large messages keeps other large ones away. */
static PyObject *fast_send_slot(FastSend *fast, PyObject *message, Py_ssize_t size, int64_t now_ns) {
    if (fast->ring == NULL || fast->ring == Py_None) return NULL;
    const int unlocked = size >= UNLOCKED_BYTES;
    PyObject *ring = Py_NewRef(fast->ring), *sent = NULL;
    if (!unlocked || fast_lock_large(fast)) {
        sent = fast_use_slot(fast, ring, message, size, unlocked, now_ns);
        if (unlocked) give_back(fast->large_release);
    }
    Py_DECREF(ring);
    return sent;
}

/* Send with the lock held; NULL without error if the message has to take the slow path. */
static PyObject *fast_send(FastSend *fast, PyObject *message) {
    const int64_t now_ns = monotonic_ns();
    if (now_ns >= fast->refresh_ns && !fast_prepare(fast, now_ns)) return NULL;
    if (fast->sends == NULL || !PyTuple_CheckExact(fast->sends) || !PyTuple_GET_SIZE(fast->sends)) return NULL;
    const Py_ssize_t size = measure_body(fast->coder, message);
    if (size < 0) return NULL;
    if (size > fast->limit) return fast_send_slot(fast, message, size, now_ns);
    if (fast_has_ring_only(fast) && fast_write_frame(fast, message, size, now_ns)) Py_RETURN_TRUE;
    PyObject *frame = make_frame(fast->coder, message, size, fast->sequence, now_ns);
    if (frame == NULL) return NULL;
    fast->sequence += 1;
    fast->bytes += size;
    PyObject *sent = fast_send_frame(fast, frame);
    Py_DECREF(frame);
    return sent;
}

static PyObject *fast_call(PyObject *self, PyObject *const *arguments, size_t flags, PyObject *keywords) {
    FastSend *fast = (FastSend *)self;
    if (PyVectorcall_NARGS(flags) != 1 || (keywords != NULL && PyTuple_GET_SIZE(keywords))) {
        PyErr_SetString(PyExc_TypeError, "publish() takes one message, by position");
        return NULL;
    }
    if (fast_send_unlocked(fast, arguments[0])) Py_RETURN_TRUE;
    PyObject *acquired = PyObject_CallNoArgs(fast->acquire);
    if (acquired == NULL) return NULL;
    Py_DECREF(acquired);
    PyObject *result = fast_send(fast, arguments[0]);
    give_back(fast->release);
    return result != NULL || PyErr_Occurred() ? result : PyObject_CallOneArg(fast->slowly, arguments[0]);
}

PyDoc_STRVAR(fast_send_slot_doc,
"send_slot($self, message, slot, /)\n--\n\n"
"Send a message whose arrays lie where they belong in a slot that is being written, with the lock held.\n\n"
"Returns:\n"
"    As a call; None if it has to take the slow path: then the arrays are as they were, and the slot is not given up.\n");

static PyObject *fast_send_slot_method(FastSend *fast, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 2)) return NULL;
    PyObject *message = arguments[0], *slot = arguments[1];
    const int64_t now_ns = monotonic_ns();
    if (now_ns >= fast->refresh_ns || fast->ring == NULL || fast->ring == Py_None) Py_RETURN_NONE;
    Py_ssize_t room;
    char *memory = slot_memory(slot, fast->ring, &room);
    const Py_ssize_t size = memory == NULL ? -1 : measure_in_place(fast->coder, message, memory, room);
    Pack pack;
    if (size <= fast->limit || !write_body(fast->coder, message, &pack, memory, size, 0)) return none_or_error(NULL);
    PyObject *sent = fast_commit(fast, slot, size, pack.stamp_ns, now_ns);
    return sent != NULL ? sent : none_or_error(NULL);
}

static PyMethodDef fast_methods[] = {
    {"send_slot", (PyCFunction)(void (*)(void))fast_send_slot_method, METH_FASTCALL, fast_send_slot_doc},
    {NULL, NULL, 0, NULL},
};

static PyObject *fast_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"coder", "acquire", "release", "locked", "slowly", "retry", "again", "limit", NULL};
    PyObject *coder, *acquire, *release, *locked, *slowly, *retry, *again;
    Py_ssize_t limit;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "O!OOOOOOn:FastSend", names, &CoderType, &coder, &acquire, &release,
                                     &locked, &slowly, &retry, &again, &limit))
        return NULL;
    FastSend *fast = (FastSend *)type->tp_alloc(type, 0);
    if (fast == NULL) return NULL;
    fast->vectorcall = fast_call;
    fast->coder = (Coder *)Py_NewRef(coder);
    fast->acquire = Py_NewRef(acquire);
    fast->release = Py_NewRef(release);
    fast->locked = Py_NewRef(locked);
    fast->slowly = Py_NewRef(slowly);
    fast->retry = Py_NewRef(retry);
    fast->again = Py_NewRef(again);
    fast->limit = limit;
    return (PyObject *)fast;
}

static int fast_traverse(FastSend *fast, visitproc visit, void *arg) {
    Py_VISIT(fast->coder);
    return visit_held(fast->held, sizeof fast->held / sizeof *fast->held, visit, arg);
}

static int fast_clear(FastSend *fast) {
    Py_CLEAR(fast->coder);
    clear_held(fast->held, sizeof fast->held / sizeof *fast->held);
    return 0;
}

static void fast_dealloc(FastSend *fast) {
    PyObject_GC_UnTrack(fast);
    fast_clear(fast);
    Py_TYPE(fast)->tp_free((PyObject *)fast);
}

static PyMemberDef fast_members[] = {
    {"sends", T_OBJECT, offsetof(FastSend, sends), 0, "Take a frame and flags; none: every message takes the slow path."},
    {"ring", T_OBJECT, offsetof(FastSend, ring), 0, "A `Broadcast`, into whose slots larger bodies go; None: the slow path."},
    {"prepare", T_OBJECT, offsetof(FastSend, prepare), 0, "Called with the lock held and the time when `refresh_ns` is over."},
    {"large_acquire", T_OBJECT, offsetof(FastSend, large_acquire), 0, "Called with False, takes the lock of large messages."},
    {"large_release", T_OBJECT, offsetof(FastSend, large_release), 0, "Gives it back."},
    {"finish", T_OBJECT, offsetof(FastSend, finish), 0, "Sends a written slot: slot, size, stamp_ns, publish_ns."},
    {"sequence", T_ULONGLONG, offsetof(FastSend, sequence), 0, "Of the next message."},
    {"bytes", T_LONGLONG, offsetof(FastSend, bytes), 0, "Of all bodies so far."},
    {"refresh_ns", T_LONGLONG, offsetof(FastSend, refresh_ns), 0, "When the next message takes the slow path."},
    {NULL, 0, 0, 0, NULL},
};

static PyTypeObject FastSendType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.FastSend",
    .tp_doc = fast_doc,
    .tp_basicsize = sizeof(FastSend),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_HAVE_VECTORCALL,
    .tp_vectorcall_offset = offsetof(FastSend, vectorcall),
    .tp_call = PyVectorcall_Call,
    .tp_new = fast_new,
    .tp_traverse = (traverseproc)fast_traverse,
    .tp_clear = (inquiry)fast_clear,
    .tp_dealloc = (destructor)fast_dealloc,
    .tp_members = fast_members,
    .tp_methods = fast_methods,
};

int add_fast_send(PyObject *module) {
    dont_wait = PyLong_FromLong(1);
    return dont_wait == NULL ? -1 : PyModule_AddType(module, &FastSendType);
}
