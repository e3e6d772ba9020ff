/* The way of a message in, one at a time; see `inlet.py`. */

#include "_coder.h"

#include <structmember.h>

static PyObject *receive_name, *expected_name, *received_name, *waiting_name;

typedef struct {
    PyObject_HEAD
    vectorcallfunc vectorcall;
    PyObject *acquire, *release, *turn, *queue, *counters, *again, *accept, *nothing;
    PyObject *link; /* NULL: every message goes the long way */
    Coder *coder;   /* the link's */
    PyObject *latency;
    int64_t clock_offset_ns;
    char exhausted;
    int64_t left, until_ns, taken_ns;
} Inlet;

PyDoc_STRVAR(inlet_doc,
"Inlet(lock, turn, queue, counters, again, accept, nothing)\n--\n\n"
"Called with whether to wait a little, it takes the next message of the only link; see `inlet.py`.\n\n"
"Args:\n"
"    lock: Held while it reads.\n"
"    turn: Its `waiting` says how many others want the lock: then there is no waiting.\n"
"    queue: What has to be taken before; while something is in it, it takes nothing.\n"
"    counters: Their `received` counts what is taken, their `latency` how long it was on its way.\n"
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
static int inlet_count(Inlet *inlet, PyObject *link, int64_t expected, int64_t publish_ns, int64_t now_ns) {
    const int64_t sent_ns = publish_ns + inlet->clock_offset_ns;
    if (now_ns < sent_ns) now_ns = monotonic_ns(); /* it was sent after we had looked at the clock */
    inlet->taken_ns = now_ns;
    const long long received = number_of(inlet->counters, received_name);
    return !PyErr_Occurred() && set_number(link, expected_name, expected + 1)
        && set_number(inlet->counters, received_name, received + 1) && note_latency(inlet->latency, now_ns - sent_ns);
}

/* The message of a frame; NULL without error if it was handed on. */
static PyObject *inlet_read(Inlet *inlet, PyObject *link, PyObject *frame, int64_t now_ns) {
    const int64_t expected = number_of(link, expected_name);
    if (expected == -1 && PyErr_Occurred()) return NULL;
    int64_t publish_ns;
    PyObject *message = read_expected(inlet->coder, frame, (uint64_t)expected, &publish_ns);
    if (message != NULL) {
        if (inlet_count(inlet, link, expected, publish_ns, now_ns)) return message;
        Py_DECREF(message);
    } else if (!PyErr_Occurred()) {
        PyObject *arguments[3] = {NULL, link, frame};
        Py_XDECREF(PyObject_Vectorcall(inlet->accept, arguments + 1, 2 | PY_VECTORCALL_ARGUMENTS_OFFSET, NULL));
    }
    return NULL;
}

/* Whether there is nothing to be taken before, and nobody who wants the lock while we would wait; -1 with an error. */
static int inlet_is_open(const Inlet *inlet, int may_wait) {
    if (inlet->link == NULL) return 0;
    const Py_ssize_t queued = PyObject_Size(inlet->queue);
    if (queued != 0) return queued < 0 ? -1 : 0;
    const long long waiting = may_wait ? number_of(inlet->turn, waiting_name) : 0;
    return waiting < 0 ? -1 : waiting == 0;
}

/* The next message, with the lock held; NULL as for `inlet_read`. */
static PyObject *inlet_take_locked(Inlet *inlet, int may_wait, int64_t now_ns) {
    if (inlet_is_open(inlet, may_wait) <= 0) return NULL;
    PyObject *link = Py_NewRef(inlet->link), *message = NULL;
    PyObject *receive = PyObject_GetAttr(link, receive_name);
    PyObject *frame = receive == NULL ? NULL : take_frame(receive, inlet->again, may_wait);
    inlet->exhausted = frame == NULL;
    if (frame != NULL) message = inlet_read(inlet, link, frame, now_ns);
    Py_XDECREF(frame);
    Py_XDECREF(receive);
    Py_DECREF(link);
    return message;
}

/* The next message, or `nothing`; NULL with an error set. The time may have passed a little. */
static PyObject *inlet_take(Inlet *inlet, int may_wait, int64_t now_ns) {
    if (inlet->link == NULL) return Py_NewRef(inlet->nothing);
    PyObject *acquired = PyObject_CallNoArgs(inlet->acquire);
    if (acquired == NULL) return NULL;
    Py_DECREF(acquired);
    PyObject *message = inlet_take_locked(inlet, may_wait, now_ns), *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    PyObject *released = PyObject_CallNoArgs(inlet->release);
    if (released == NULL) PyErr_Clear(); /* it was ours */
    Py_XDECREF(released);
    PyErr_Restore(type, value, traceback);
    return message != NULL || PyErr_Occurred() ? message : Py_NewRef(inlet->nothing);
}

static PyObject *inlet_call(PyObject *self, PyObject *const *arguments, size_t flags, PyObject *keywords) {
    if (PyVectorcall_NARGS(flags) != 1 || (keywords != NULL && PyTuple_GET_SIZE(keywords))) {
        PyErr_SetString(PyExc_TypeError, "expected whether to wait, by position");
        return NULL;
    }
    const int may_wait = PyObject_IsTrue(arguments[0]);
    return may_wait < 0 ? NULL : inlet_take((Inlet *)self, may_wait, INT64_MIN);
}

static PyObject *inlet_soon(PyObject *self, PyObject *unused) {
    (void)unused;
    Inlet *inlet = (Inlet *)self;
    const int64_t now_ns = monotonic_ns();
    const int may_go_on = inlet->left > 0 && now_ns < inlet->until_ns;
    inlet->left -= may_go_on;
    return may_go_on ? inlet_take(inlet, 0, now_ns) : Py_NewRef(inlet->nothing);
}

static PyObject *inlet_open(Inlet *inlet, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 2)) return NULL;
    PyObject *link = arguments[0], *coder = arguments[1];
    const int is_open = link != Py_None && Py_IS_TYPE(coder, &CoderType);
    if (is_open) {
        PyObject *offset = PyObject_GetAttrString(link, "clock_offset_ns");
        inlet->clock_offset_ns = offset == NULL ? -1 : PyLong_AsLongLong(offset);
        Py_XDECREF(offset);
        if (PyErr_Occurred()) return NULL;
    }
    Py_XSETREF(inlet->coder, is_open ? (Coder *)Py_NewRef(coder) : NULL);
    Py_XSETREF(inlet->link, is_open ? Py_NewRef(link) : NULL);
    Py_RETURN_NONE;
}

static PyObject *inlet_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"lock", "turn", "queue", "counters", "again", "accept", "nothing", NULL};
    PyObject *lock, *turn, *queue, *counters, *again, *accept, *nothing;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "OOOOOOO:Inlet", names, &lock, &turn, &queue, &counters, &again,
                                     &accept, &nothing))
        return NULL;
    Inlet *inlet = (Inlet *)type->tp_alloc(type, 0);
    if (inlet == NULL) return NULL;
    inlet->vectorcall = inlet_call;
    inlet->exhausted = 1;
    inlet->turn = Py_NewRef(turn);
    inlet->queue = Py_NewRef(queue);
    inlet->counters = Py_NewRef(counters);
    inlet->again = Py_NewRef(again);
    inlet->accept = Py_NewRef(accept);
    inlet->nothing = Py_NewRef(nothing);
    inlet->acquire = PyObject_GetAttrString(lock, "acquire");
    inlet->release = PyObject_GetAttrString(lock, "release");
    inlet->latency = PyObject_GetAttrString(counters, "latency");
    if (inlet->acquire == NULL || inlet->release == NULL || inlet->latency == NULL) Py_CLEAR(inlet);
    return (PyObject *)inlet;
}

static int inlet_traverse(Inlet *inlet, visitproc visit, void *arg) {
    Py_VISIT(inlet->acquire);
    Py_VISIT(inlet->release);
    Py_VISIT(inlet->turn);
    Py_VISIT(inlet->queue);
    Py_VISIT(inlet->counters);
    Py_VISIT(inlet->again);
    Py_VISIT(inlet->accept);
    Py_VISIT(inlet->nothing);
    Py_VISIT(inlet->link);
    Py_VISIT(inlet->coder);
    Py_VISIT(inlet->latency);
    return 0;
}

static int inlet_clear(Inlet *inlet) {
    Py_CLEAR(inlet->link); /* first: then the rest is not used */
    Py_CLEAR(inlet->coder);
    Py_CLEAR(inlet->acquire);
    Py_CLEAR(inlet->release);
    Py_CLEAR(inlet->turn);
    Py_CLEAR(inlet->queue);
    Py_CLEAR(inlet->counters);
    Py_CLEAR(inlet->again);
    Py_CLEAR(inlet->accept);
    Py_CLEAR(inlet->latency);
    return 0; /* `nothing` holds nothing, and may still be returned */
}

static void inlet_dealloc(Inlet *inlet) {
    PyObject_GC_UnTrack(inlet);
    inlet_clear(inlet);
    Py_CLEAR(inlet->nothing);
    Py_TYPE(inlet)->tp_free((PyObject *)inlet);
}

static PyMethodDef inlet_methods[] = {
    {"open", (PyCFunction)(void (*)(void))inlet_open, METH_FASTCALL,
     "Read a link from now on, with its coder; None: every message goes the long way."},
    {"soon", inlet_soon, METH_NOARGS, "As a call with False, while `left` and `until_ns` allow it."},
    {NULL, NULL, 0, NULL},
};

static PyObject *inlet_get_open(Inlet *inlet, void *unused) {
    (void)unused;
    return PyBool_FromLong(inlet->link != NULL);
}

static PyGetSetDef inlet_properties[] = {
    {"is_open", (getter)inlet_get_open, NULL, "Whether there is a link to read.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyMemberDef inlet_members[] = {
    {"exhausted", T_BOOL, offsetof(Inlet, exhausted), 0, "Whether the last look found nothing."},
    {"left", T_LONGLONG, offsetof(Inlet, left), 0, "Messages that `soon` may still take."},
    {"taken_ns", T_LONGLONG, offsetof(Inlet, taken_ns), READONLY, "When the last message was taken."},
    {"until_ns", T_LONGLONG, offsetof(Inlet, until_ns), 0, "How long it may do so, on the monotonic clock."},
    {NULL, 0, 0, 0, NULL},
};

static PyTypeObject InletType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Inlet",
    .tp_doc = inlet_doc,
    .tp_basicsize = sizeof(Inlet),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_HAVE_VECTORCALL,
    .tp_vectorcall_offset = offsetof(Inlet, vectorcall),
    .tp_call = PyVectorcall_Call,
    .tp_new = inlet_new,
    .tp_traverse = (traverseproc)inlet_traverse,
    .tp_clear = (inquiry)inlet_clear,
    .tp_dealloc = (destructor)inlet_dealloc,
    .tp_methods = inlet_methods,
    .tp_members = inlet_members,
    .tp_getset = inlet_properties,
};

int add_inlet(PyObject *module) {
    receive_name = PyUnicode_InternFromString("receive");
    expected_name = PyUnicode_InternFromString("expected");
    received_name = PyUnicode_InternFromString("received");
    waiting_name = PyUnicode_InternFromString("waiting");
    if (receive_name == NULL || expected_name == NULL || received_name == NULL || waiting_name == NULL) return -1;
    return PyModule_AddType(module, &InletType);
}
