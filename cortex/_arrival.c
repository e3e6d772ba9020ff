/* Messages for `async for`; see `inlet.py`. Each is awaited as an `Arrival`, which takes it when it is first sent to, as a coroutine
   would; one that has to wait goes on as the coroutine that `slowly` makes. */

#include "_inlet.h"

typedef enum { FRESH, WAITING, DONE } Phase;

typedef struct {
    PyObject_HEAD
    PyObject *inlet;
    PyObject *slowly;
    PyObject *waiting; /* the coroutine, while WAITING */
    Phase phase;
} Arrival;

typedef struct {
    PyObject_HEAD
    PyObject *inlet;
    PyObject *slowly;
    Arrival *last; /* used again once nobody else has it */
} Arrivals;

static PyTypeObject ArrivalType;

static int arrival_wait(Arrival *arrival) {
    arrival->waiting = PyObject_CallNoArgs(arrival->slowly);
    if (arrival->waiting != NULL) arrival->phase = WAITING;
    return arrival->waiting != NULL;
}

static void arrival_end(Arrival *arrival) {
    arrival->phase = DONE;
    Py_CLEAR(arrival->waiting);
}

static PySendResult arrival_step(Arrival *arrival, PyObject *value, PyObject **result) {
    *result = NULL;
    if (arrival->phase == DONE) {
        PyErr_SetString(PyExc_RuntimeError, "cannot await an arrival twice");
        return PYGEN_ERROR;
    }
    if (arrival->phase == FRESH) {
        if (inlet_take_soon(arrival->inlet, result)) {
            arrival->phase = DONE;
            return *result == NULL ? PYGEN_ERROR : PYGEN_RETURN;
        }
        Py_CLEAR(*result);
        if (!arrival_wait(arrival)) return PYGEN_ERROR;
    }
    PyObject *waiting = Py_NewRef(arrival->waiting);
    const PySendResult found = PyIter_Send(waiting, value, result);
    Py_DECREF(waiting);
    if (found != PYGEN_NEXT) arrival_end(arrival);
    return found;
}

/* What `arrival_step` found, as a generator's methods say it. */
static PyObject *said(PySendResult found, PyObject *result) {
    if (found != PYGEN_RETURN) return result;
    PyObject *stop = PyObject_CallOneArg(PyExc_StopIteration, result);
    Py_DECREF(result);
    if (stop != NULL) PyErr_SetObject(PyExc_StopIteration, stop);
    Py_XDECREF(stop);
    return NULL;
}

static PyObject *arrival_send(Arrival *arrival, PyObject *value) {
    PyObject *result;
    const PySendResult found = arrival_step(arrival, value, &result);
    return said(found, result);
}

static PyObject *arrival_next(Arrival *arrival) { return arrival_send(arrival, Py_None); }

static PyObject *arrival_throw(Arrival *arrival, PyObject *arguments) {
    if (arrival->phase == DONE) {
        PyErr_SetString(PyExc_RuntimeError, "cannot await an arrival twice");
        return NULL;
    }
    if (arrival->phase == FRESH && !arrival_wait(arrival)) return NULL;
    PyObject *throw = PyObject_GetAttrString(arrival->waiting, "throw");
    PyObject *result = throw == NULL ? NULL : PyObject_CallObject(throw, arguments);
    Py_XDECREF(throw);
    if (result == NULL) arrival_end(arrival);
    return result;
}

static PyObject *arrival_close(Arrival *arrival, PyObject *unused) {
    (void)unused;
    PyObject *waiting = arrival->waiting, *closed = NULL;
    arrival->waiting = NULL;
    arrival->phase = DONE;
    if (waiting == NULL) Py_RETURN_NONE;
    closed = PyObject_CallMethod(waiting, "close", NULL);
    Py_DECREF(waiting);
    return closed;
}

static int arrival_traverse(Arrival *arrival, visitproc visit, void *arg) {
    Py_VISIT(arrival->inlet);
    Py_VISIT(arrival->slowly);
    Py_VISIT(arrival->waiting);
    return 0;
}

static int arrival_clear(Arrival *arrival) {
    arrival->phase = DONE;
    Py_CLEAR(arrival->inlet);
    Py_CLEAR(arrival->slowly);
    Py_CLEAR(arrival->waiting);
    return 0;
}

static void arrival_dealloc(Arrival *arrival) {
    PyObject_GC_UnTrack(arrival);
    arrival_clear(arrival);
    Py_TYPE(arrival)->tp_free((PyObject *)arrival);
}

static PyMethodDef arrival_methods[] = {
    {"send", (PyCFunction)arrival_send, METH_O, "As a coroutine's."},
    {"throw", (PyCFunction)arrival_throw, METH_VARARGS, "As a coroutine's."},
    {"close", (PyCFunction)arrival_close, METH_NOARGS, "As a coroutine's."},
    {NULL, NULL, 0, NULL},
};

static PyAsyncMethods arrival_async = {.am_await = PyObject_SelfIter, .am_send = (sendfunc)arrival_step};

static PyTypeObject ArrivalType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Arrival",
    .tp_doc = "The next message, to be awaited.",
    .tp_basicsize = sizeof(Arrival),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .tp_as_async = &arrival_async,
    .tp_iter = PyObject_SelfIter,
    .tp_iternext = (iternextfunc)arrival_next,
    .tp_traverse = (traverseproc)arrival_traverse,
    .tp_clear = (inquiry)arrival_clear,
    .tp_dealloc = (destructor)arrival_dealloc,
    .tp_methods = arrival_methods,
};

static PyObject *arrivals_next(Arrivals *arrivals) {
    Arrival *last = arrivals->last;
    if (last != NULL && last->inlet != NULL && Py_REFCNT(last) == 1 && last->phase == DONE) {
        last->phase = FRESH;
        return Py_NewRef(last);
    }
    Arrival *arrival = (Arrival *)ArrivalType.tp_alloc(&ArrivalType, 0);
    if (arrival == NULL) return NULL;
    arrival->inlet = Py_NewRef(arrivals->inlet);
    arrival->slowly = Py_NewRef(arrivals->slowly);
    Py_XSETREF(arrivals->last, (Arrival *)Py_NewRef(arrival));
    return (PyObject *)arrival;
}

static PyObject *arrivals_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"inlet", "slowly", NULL};
    PyObject *inlet, *slowly;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "O!O:Arrivals", names, &InletType, &inlet, &slowly)) return NULL;
    Arrivals *arrivals = (Arrivals *)type->tp_alloc(type, 0);
    if (arrivals == NULL) return NULL;
    arrivals->inlet = Py_NewRef(inlet);
    arrivals->slowly = Py_NewRef(slowly);
    return (PyObject *)arrivals;
}

static int arrivals_traverse(Arrivals *arrivals, visitproc visit, void *arg) {
    Py_VISIT(arrivals->inlet);
    Py_VISIT(arrivals->slowly);
    Py_VISIT(arrivals->last);
    return 0;
}

static int arrivals_clear(Arrivals *arrivals) {
    Py_CLEAR(arrivals->inlet);
    Py_CLEAR(arrivals->slowly);
    Py_CLEAR(arrivals->last);
    return 0;
}

static void arrivals_dealloc(Arrivals *arrivals) {
    PyObject_GC_UnTrack(arrivals);
    arrivals_clear(arrivals);
    Py_TYPE(arrivals)->tp_free((PyObject *)arrivals);
}

static PyAsyncMethods arrivals_async = {.am_aiter = PyObject_SelfIter, .am_anext = (unaryfunc)arrivals_next};

static PyTypeObject ArrivalsType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Arrivals",
    .tp_doc = "Arrivals(inlet, slowly)\n--\n\n"
              "Messages as they come, for `async for`.\n\n"
              "Args:\n"
              "    inlet: An `Inlet`; whence they come.\n"
              "    slowly: Makes a coroutine that waits for the next.\n",
    .tp_basicsize = sizeof(Arrivals),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .tp_as_async = &arrivals_async,
    .tp_new = arrivals_new,
    .tp_traverse = (traverseproc)arrivals_traverse,
    .tp_clear = (inquiry)arrivals_clear,
    .tp_dealloc = (destructor)arrivals_dealloc,
};

int add_arrival(PyObject *module) {
    return PyType_Ready(&ArrivalType) < 0 ? -1 : PyModule_AddType(module, &ArrivalsType);
}
