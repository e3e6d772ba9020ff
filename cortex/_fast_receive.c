/* The way of a message in, one at a time; see `fast_receive.py`. */

#include "_coder.h"

#include <structmember.h>

static PyObject *receive_name, *expected_name, *received_name, *waiting_name, *offset_name;

typedef struct {
    PyObject_HEAD
    vectorcallfunc vectorcall;
    union {
        struct {
            PyObject *link;  /* NULL: every message takes the slow path */
            PyObject *coder; /* the link's */
            PyObject *receive_lock, *queue, *counters, *again, *accept, *acquire, *release, *locked, *latency, *nothing;
        };
        PyObject *held[12];
    };
    int64_t clock_offset_ns;
    char exhausted;
    int64_t left, until_ns, taken_ns;
} FastReceive;

PyDoc_STRVAR(fast_doc,
"FastReceive(lock, receive_lock, queue, counters, again, accept, nothing)\n--\n\n"
"Called with whether to wait a little, it takes the next message of the only link; see `fast_receive.py`.\n\n"
"Args:\n"
"    lock: Held while it reads.\n"
"    receive_lock: Its `waiting` says how many others want the lock: then there is no waiting.\n"
"    queue: What has to be taken before; while something is in it, it takes nothing.\n"
"    counters: Their `received` counts what is taken, their `latency` how long it was in flight.\n"
"    again: What a link's `receive` raises where nothing is there.\n"
"    accept: Called with the lock held, the link, and a frame that does not simply follow.\n"
"    nothing: Returned where there is no message.\n");

/* An attribute that is a small number; -1 with an error set. */
static long long number_of(PyObject *object, PyObject *name) {
    PyObject *value = PyObject_GetAttr(object, name);
    if (value == NULL) return -1;
    const long long number = PyLong_AsLongLong(value);
    Py_DECREF(value);
    return number;
}

static int set_number(PyObject *object, PyObject *name, long long number) {
    PyObject *value = PyLong_FromLongLong(number);
    const int failed = value == NULL || PyObject_SetAttr(object, name, value) < 0;
    Py_XDECREF(value);
    return !failed;
}

/* Account for a message that was read; 0 with an error set. */
static int fast_count(FastReceive *fast, PyObject *link, int64_t expected, int64_t publish_ns, int64_t now_ns) {
    const int64_t sent_ns = publish_ns + fast->clock_offset_ns;
    if (now_ns < sent_ns) now_ns = monotonic_ns(); /* it was sent after we had looked at the clock */
    fast->taken_ns = now_ns;
    const long long received = number_of(fast->counters, received_name);
    return !PyErr_Occurred() && set_number(link, expected_name, expected + 1)
        && set_number(fast->counters, received_name, received + 1) && note_latency(fast->latency, now_ns - sent_ns);
}

/* The message of a frame; NULL without error if it is something else, or does not follow. */
static PyObject *fast_read(FastReceive *fast, PyObject *link, PyObject *frame, int64_t expected, int64_t now_ns) {
    int64_t publish_ns;
    PyObject *message = read_expected((const Coder *)fast->coder, frame, (uint64_t)expected, &publish_ns);
    if (message == NULL || fast_count(fast, link, expected, publish_ns, now_ns)) return message;
    Py_DECREF(message);
    return NULL;
}

/* Whether there is nothing to be taken before, and nobody who wants the lock while we would wait; -1 with an error. */
static int fast_is_open(const FastReceive *fast, int may_wait) {
    if (fast->link == NULL) return 0;
    const Py_ssize_t queued = PyObject_Size(fast->queue);
    if (queued != 0) return queued < 0 ? -1 : 0;
    const long long waiting = may_wait ? number_of(fast->receive_lock, waiting_name) : 0;
    return waiting < 0 ? -1 : waiting == 0;
}

/* The next message; NULL without error if there is none, or a frame that `other` gets. */
static PyObject *fast_look(FastReceive *fast, PyObject *link, PyObject *receive, int may_wait, int64_t expected, int64_t now_ns,
                           PyObject **other) {
    if (fast_is_open(fast, may_wait) <= 0) return NULL;
    PyObject *frame = take_frame(receive, fast->again, may_wait);
    fast->exhausted = frame == NULL;
    if (frame == NULL) return NULL;
    PyObject *message = fast_read(fast, link, frame, expected, now_ns);
    if (message == NULL && !PyErr_Occurred()) *other = frame;
    else Py_DECREF(frame);
    return message;
}

/* As `fast_look`, with the lock; a frame that is something else is handed on. */
static PyObject *fast_look_locked(FastReceive *fast, PyObject *link, PyObject *receive, int may_wait, int64_t now_ns, PyObject *other) {
    PyObject *acquired = PyObject_CallNoArgs(fast->acquire), *message = NULL;
    const int64_t expected = acquired == NULL ? -1 : number_of(link, expected_name); /* others may have read meanwhile */
    if (!PyErr_Occurred() && other == NULL) message = fast_look(fast, link, receive, may_wait, expected, now_ns, &other);
    if (acquired != NULL && other != NULL) {
        PyObject *arguments[3] = {NULL, link, other};
        Py_XDECREF(PyObject_Vectorcall(fast->accept, arguments + 1, 2 | PY_VECTORCALL_ARGUMENTS_OFFSET, NULL));
    }
    Py_XDECREF(other);
    if (acquired != NULL) give_back(fast->release);
    Py_XDECREF(acquired);
    return message;
}

/* The next message, or `nothing`; NULL with an error set. The time may have passed a little. The lock is not taken where it
   is free and no Python code runs, that of the garbage collector included. */
static PyObject *fast_take(FastReceive *fast, int may_wait, int64_t now_ns) {
    if (fast->link == NULL) return Py_NewRef(fast->nothing);
    PyObject *link = Py_NewRef(fast->link), *receive = PyObject_GetAttr(link, receive_name), *message = NULL, *other = NULL;
    int is_done = receive == NULL;
    const int64_t expected = is_done ? -1 : number_of(link, expected_name);
    if (expected >= 0 && is_free(fast->locked) && may_look_unlocked(receive, may_wait, (uint64_t)expected)) {
        const int collects = PyGC_Disable();
        message = fast_look(fast, link, receive, 0, expected, now_ns, &other);
        if (collects) PyGC_Enable();
        is_done = message != NULL || PyErr_Occurred() || (other == NULL && !may_wait);
    }
    if (!is_done && !PyErr_Occurred()) message = fast_look_locked(fast, link, receive, may_wait, now_ns, other);
    Py_XDECREF(receive);
    Py_DECREF(link);
    return message != NULL || PyErr_Occurred() ? message : Py_NewRef(fast->nothing);
}

static PyObject *fast_call(PyObject *self, PyObject *const *arguments, size_t flags, PyObject *keywords) {
    if (PyVectorcall_NARGS(flags) != 1 || (keywords != NULL && PyTuple_GET_SIZE(keywords))) {
        PyErr_SetString(PyExc_TypeError, "expected whether to wait, by position");
        return NULL;
    }
    const int may_wait = PyObject_IsTrue(arguments[0]);
    return may_wait < 0 ? NULL : fast_take((FastReceive *)self, may_wait, INT64_MIN);
}

static PyObject *fast_soon(PyObject *self, PyObject *unused) {
    (void)unused;
    FastReceive *fast = (FastReceive *)self;
    const int64_t now_ns = monotonic_ns();
    const int may_go_on = fast->left > 0 && now_ns < fast->until_ns;
    fast->left -= may_go_on;
    return may_go_on ? fast_take(fast, 0, now_ns) : Py_NewRef(fast->nothing);
}

static PyObject *fast_open(FastReceive *fast, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 2)) return NULL;
    PyObject *link = arguments[0], *coder = arguments[1];
    const int is_open = link != Py_None && Py_IS_TYPE(coder, &CoderType);
    if (is_open) fast->clock_offset_ns = number_of(link, offset_name);
    if (PyErr_Occurred()) return NULL;
    Py_XSETREF(fast->coder, is_open ? Py_NewRef(coder) : NULL);
    Py_XSETREF(fast->link, is_open ? Py_NewRef(link) : NULL);
    Py_RETURN_NONE;
}

PyDoc_STRVAR(drain_doc,
"drain($self, link, messages, limit, may_wait, /)\n--\n\n"
"Read plain frames of any link that follow one another, and append their messages; the lock is held.\n\n"
"Args:\n"
"    link: It has a coder; its `expected` is kept.\n"
"    messages: A deque.\n"
"    limit: Most messages to read.\n"
"    may_wait: Whether to wait a little for the first.\n\n"
"Returns:\n"
"    The frame that ended it, as it is something else, or out of sequence; None if there was no more, or that was the limit.\n");

/* Append the message that a frame has; 0 with an error set, or without if it is something else. */
static int drain_one(const Coder *coder, PyObject *frame, int64_t expected, PyObject *append, int64_t *publish_ns) {
    PyObject *message = read_expected(coder, frame, (uint64_t)expected, publish_ns);
    PyObject *appended = message == NULL ? NULL : PyObject_CallOneArg(append, message);
    Py_XDECREF(message);
    Py_XDECREF(appended);
    return appended != NULL;
}

static PyObject *fast_drain(FastReceive *fast, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 4)) return NULL;
    PyObject *link = arguments[0], *frame = NULL;
    const Py_ssize_t limit = PyLong_AsSsize_t(arguments[2]);
    const int may_wait = PyObject_IsTrue(arguments[3]);
    int64_t expected = number_of(link, expected_name), publish_ns;
    const int64_t offset_ns = PyErr_Occurred() ? 0 : number_of(link, offset_name);
    if (PyErr_Occurred()) return NULL;
    PyObject *coder = PyObject_GetAttrString(link, "coder");
    PyObject *receive = coder == NULL ? NULL : PyObject_GetAttr(link, receive_name);
    PyObject *append = receive == NULL ? NULL : PyObject_GetAttrString(arguments[1], "append");
    const int is_fit = append != NULL && Py_IS_TYPE(coder, &CoderType);
    for (Py_ssize_t read = 0; is_fit && read < limit; ++read, ++expected) {
        frame = take_frame(receive, fast->again, may_wait && read == 0);
        if (frame == NULL || !drain_one((const Coder *)coder, frame, expected, append, &publish_ns)) break;
        Py_CLEAR(frame);
        /* every eighth: to look at the clock for each would cost a tenth */
        if (read % 8 == 0 && !note_latency(fast->latency, monotonic_ns() - publish_ns - offset_ns)) break;
    }
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    const int is_kept = is_fit && set_number(link, expected_name, expected);
    if (type != NULL) PyErr_Restore(type, value, traceback);
    Py_XDECREF(append);
    Py_XDECREF(receive);
    Py_XDECREF(coder);
    if (is_kept && !PyErr_Occurred()) return frame != NULL ? frame : Py_NewRef(Py_None);
    if (!PyErr_Occurred()) PyErr_SetString(PyExc_TypeError, "expected a link with a coder");
    Py_XDECREF(frame);
    return NULL;
}

static PyObject *fast_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"lock", "receive_lock", "queue", "counters", "again", "accept", "nothing", NULL};
    PyObject *lock, *receive_lock, *queue, *counters, *again, *accept, *nothing;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "OOOOOOO:FastReceive", names, &lock, &receive_lock, &queue, &counters, &again,
                                     &accept, &nothing))
        return NULL;
    FastReceive *fast = (FastReceive *)type->tp_alloc(type, 0);
    if (fast == NULL) return NULL;
    fast->vectorcall = fast_call;
    fast->exhausted = 1;
    fast->receive_lock = Py_NewRef(receive_lock);
    fast->queue = Py_NewRef(queue);
    fast->counters = Py_NewRef(counters);
    fast->again = Py_NewRef(again);
    fast->accept = Py_NewRef(accept);
    fast->nothing = Py_NewRef(nothing);
    fast->acquire = PyObject_GetAttrString(lock, "acquire");
    fast->release = PyObject_GetAttrString(lock, "release");
    fast->locked = PyObject_GetAttrString(lock, "locked");
    fast->latency = PyObject_GetAttrString(counters, "latency");
    if (fast->acquire == NULL || fast->release == NULL || fast->locked == NULL || fast->latency == NULL) Py_CLEAR(fast);
    return (PyObject *)fast;
}

static int fast_traverse(FastReceive *fast, visitproc visit, void *arg) {
    return visit_held(fast->held, sizeof fast->held / sizeof *fast->held, visit, arg);
}

static int fast_clear(FastReceive *fast) { /* the link first: then the rest is not used */
    clear_held(fast->held, sizeof fast->held / sizeof *fast->held - 1);
    return 0; /* `nothing` holds nothing, and may still be returned */
}

static void fast_dealloc(FastReceive *fast) {
    PyObject_GC_UnTrack(fast);
    fast_clear(fast);
    Py_CLEAR(fast->nothing);
    Py_TYPE(fast)->tp_free((PyObject *)fast);
}

static PyMethodDef fast_methods[] = {
    {"open", (PyCFunction)(void (*)(void))fast_open, METH_FASTCALL,
     "Read a link from now on, with its coder; None: every message takes the slow path."},
    {"drain", (PyCFunction)(void (*)(void))fast_drain, METH_FASTCALL, drain_doc},
    {"soon", fast_soon, METH_NOARGS, "As a call with False, while `left` and `until_ns` allow it."},
    {NULL, NULL, 0, NULL},
};

static PyObject *fast_get_open(FastReceive *fast, void *unused) {
    (void)unused;
    return PyBool_FromLong(fast->link != NULL);
}

static PyGetSetDef fast_properties[] = {
    {"is_open", (getter)fast_get_open, NULL, "Whether there is a link to read.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyMemberDef fast_members[] = {
    {"exhausted", T_BOOL, offsetof(FastReceive, exhausted), 0, "Whether the last look found nothing."},
    {"left", T_LONGLONG, offsetof(FastReceive, left), 0, "Messages that `soon` may still take."},
    {"taken_ns", T_LONGLONG, offsetof(FastReceive, taken_ns), READONLY, "When the last message was taken."},
    {"until_ns", T_LONGLONG, offsetof(FastReceive, until_ns), 0, "How long it may do so, on the monotonic clock."},
    {NULL, 0, 0, 0, NULL},
};

static PyTypeObject FastReceiveType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.FastReceive",
    .tp_doc = fast_doc,
    .tp_basicsize = sizeof(FastReceive),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_HAVE_VECTORCALL,
    .tp_vectorcall_offset = offsetof(FastReceive, vectorcall),
    .tp_call = PyVectorcall_Call,
    .tp_new = fast_new,
    .tp_traverse = (traverseproc)fast_traverse,
    .tp_clear = (inquiry)fast_clear,
    .tp_dealloc = (destructor)fast_dealloc,
    .tp_methods = fast_methods,
    .tp_members = fast_members,
    .tp_getset = fast_properties,
};

int add_fast_receive(PyObject *module) {
    receive_name = PyUnicode_InternFromString("receive");
    expected_name = PyUnicode_InternFromString("expected");
    received_name = PyUnicode_InternFromString("received");
    waiting_name = PyUnicode_InternFromString("waiting");
    offset_name = PyUnicode_InternFromString("clock_offset_ns");
    if (receive_name == NULL || expected_name == NULL || received_name == NULL || waiting_name == NULL || offset_name == NULL) return -1;
    return PyModule_AddType(module, &FastReceiveType);
}
