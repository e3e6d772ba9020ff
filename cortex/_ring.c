/* Who holds which slot of a ring, in C: what `ledger.py` and `RingView.lease` of `shm.py` do, in a tenth of the time.

   Section 6 of WIRE.md has the layout and the rules. A `Ledger` is the publisher's account of its slots, a `SlotView`
   a reader's, a `Lease` keeps one message. All run under the GIL, so nothing here needs a lock; the memory is shared
   with other processes, so every look at it goes through atomic operations of the order that the rules need. */

#include "_ring.h"

#include <stddef.h>
#include <string.h>
#include <structmember.h>

#define NPY_NO_DEPRECATED_API NPY_1_19_API_VERSION
#define NPY_TARGET_VERSION NPY_1_19_API_VERSION
#define NO_IMPORT_ARRAY
#define PY_ARRAY_UNIQUE_SYMBOL cortex_numpy
#include <numpy/arrayobject.h>

enum {
    COLUMNS = 64,
    STATE = 0, /* words of a slot's header */
    SEQUENCE = 1,
    SIZE = 2,
    HEADER_WORDS = 8,
    HEAD_SIZE = 24,
    PLACE_SIZE = 32,
    HEADER_SIZE = 64,
    DESCRIPTOR_SIZE = HEADER_SIZE + 8 + PLACE_SIZE,
};
static const uint64_t NO_SEQUENCE = UINT64_MAX;

static uint64_t load_word(const uint64_t *word) { return __atomic_load_n(word, __ATOMIC_ACQUIRE); }
static void store_word(uint64_t *word, uint64_t value) { __atomic_store_n(word, value, __ATOMIC_RELEASE); }

/* Ledger */

struct Ledger {
    PyObject_HEAD
    Py_buffer memory; /* of the whole ring, until the end */
    Py_ssize_t slots, slot_bytes;
    uint8_t *leases;   /* [slots][COLUMNS] */
    uint64_t *headers; /* [slots][HEADER_WORDS] */
    char *first;
    uint64_t *state;   /* what we wrote there; readers can write to the headers */
    uint64_t *granted; /* columns of a slot's message, some given back */
    uint64_t *written; /* when a slot was last written: `clock` */
    uint32_t *busy;    /* pins, and one more while the slot is being written */
    uint64_t clock;
    Py_ssize_t last;
    Py_ssize_t turns;  /* so many messages go into slots by turns; -1: all */
    Py_ssize_t held[COLUMNS]; /* slots of a column, some given back */
    Py_ssize_t quota[COLUMNS];
    uint64_t mask;     /* columns of all readers */
    char head[HEAD_SIZE], place[PLACE_SIZE];
    uint32_t ring;
    int closed;
    int users; /* who copies into the memory without the GIL */
};

static inline uint8_t *lease_byte(uint8_t *leases, Py_ssize_t slot, int column) { return leases + slot * COLUMNS + column; }

/* The columns that still hold a slot. */
static uint64_t holders(Ledger *ledger, Py_ssize_t slot) {
    uint64_t left = ledger->granted[slot];
    for (uint64_t rest = left; rest; rest &= rest - 1) {
        const int column = __builtin_ctzll(rest);
        if (__atomic_load_n(lease_byte(ledger->leases, slot, column), __ATOMIC_ACQUIRE) == 0) left &= ~(1ull << column);
    }
    return left;
}

static int is_free(Ledger *ledger, Py_ssize_t slot) { return !ledger->busy[slot] && !holders(ledger, slot); }

/* The free slot that was written last, so that it is still in our cache. By turns after a reader was passed over: it
   may want to copy what it has no lease of. */
static Py_ssize_t free_slot(Ledger *ledger) {
    Py_ssize_t found = -1;
    if (ledger->turns == 0) {
        for (Py_ssize_t slot = 0; slot < ledger->slots; ++slot) {
            if ((found < 0 || ledger->written[slot] > ledger->written[found]) && is_free(ledger, slot)) found = slot;
        }
        return found;
    }
    if (ledger->turns > 0) ledger->turns -= 1;
    for (Py_ssize_t step = 1; step <= ledger->slots; ++step) {
        const Py_ssize_t slot = (ledger->last + step) % ledger->slots;
        if (is_free(ledger, slot)) return slot;
    }
    return -1;
}

static Py_ssize_t begin_writing(Ledger *ledger) {
    const Py_ssize_t slot = ledger->closed ? -1 : free_slot(ledger);
    if (slot < 0) return -1;
    ledger->last = slot;
    ledger->written[slot] = ++ledger->clock;
    ledger->busy[slot] = 1;
    store_word(ledger->headers + slot * HEADER_WORDS + STATE, ledger->state[slot] += 1);
    __atomic_thread_fence(__ATOMIC_SEQ_CST); /* before any byte of the content */
    return slot;
}

static void end_writing(Ledger *ledger, Py_ssize_t slot, uint64_t sequence, uint64_t size, uint64_t mask) {
    if (ledger->closed) return;
    uint64_t *header = ledger->headers + slot * HEADER_WORDS;
    store_word(header + SEQUENCE, sequence);
    store_word(header + SIZE, size);
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    store_word(header + STATE, ledger->state[slot] += 1);
    ledger->granted[slot] = mask;
    for (uint64_t rest = mask; rest; rest &= rest - 1) {
        const int column = __builtin_ctzll(rest);
        __atomic_store_n(lease_byte(ledger->leases, slot, column), 1, __ATOMIC_RELEASE);
        ledger->held[column] += 1;
    }
    ledger->busy[slot] -= 1;
}

/* How many slots a column holds. */
static Py_ssize_t outstanding(Ledger *ledger, int column) {
    if (!ledger->held[column]) return 0;
    Py_ssize_t count = 0;
    for (Py_ssize_t slot = 0; slot < ledger->slots; ++slot) {
        if (!(ledger->granted[slot] >> column & 1)) continue;
        if (__atomic_load_n(lease_byte(ledger->leases, slot, column), __ATOMIC_ACQUIRE)) count += 1;
        else ledger->granted[slot] &= ~(1ull << column);
    }
    return ledger->held[column] = count;
}

/* What was granted bounds what is held: most calls need no look at the lease bytes. */
static int has_room(Ledger *ledger, int column, Py_ssize_t quota) {
    return ledger->held[column] < quota || outstanding(ledger, column) < quota;
}

Py_ssize_t ledger_acquire(Ledger *ledger, Py_ssize_t size) {
    return size > ledger->slot_bytes ? -1 : begin_writing(ledger);
}

char *ledger_memory(Ledger *ledger, Py_ssize_t slot) { return ledger->first + slot * ledger->slot_bytes; }

int ledger_is_writing(const Ledger *ledger, Py_ssize_t slot) {
    return !ledger->closed && slot >= 0 && slot < ledger->slots && ledger->state[slot] & 1;
}

Py_ssize_t ledger_slot_bytes(const Ledger *ledger) { return ledger->slot_bytes; }

int ledger_has_room(Ledger *ledger) {
    if (ledger->closed) return 0;
    for (uint64_t rest = ledger->mask; rest; rest &= rest - 1) {
        const int column = __builtin_ctzll(rest);
        if (!has_room(ledger, column, ledger->quota[column])) return 0;
    }
    return 1;
}

PyObject *ledger_commit(
    Ledger *ledger, Py_ssize_t slot, uint64_t sequence, int64_t stamp_ns, int64_t publish_ns, Py_ssize_t size) {
    PyObject *descriptor = PyBytes_FromStringAndSize(NULL, DESCRIPTOR_SIZE);
    if (descriptor == NULL) return NULL;
    char *out = PyBytes_AS_STRING(descriptor);
    const uint64_t rest[6] = {sequence, (uint64_t)stamp_ns, (uint64_t)publish_ns, (uint64_t)size,
                              (uint64_t)ledger->ring << 32 | (uint64_t)slot, ledger->mask};
    memcpy(out, ledger->head, HEAD_SIZE);
    memcpy(out + HEAD_SIZE, rest, sizeof rest);
    memcpy(out + HEADER_SIZE + 8, ledger->place, PLACE_SIZE);
    end_writing(ledger, slot, sequence, (uint64_t)size, ledger->mask);
    return descriptor;
}

void ledger_abandon(Ledger *ledger, Py_ssize_t slot) {
    /* What was there is overwritten in part: nobody may copy it. */
    end_writing(ledger, slot, NO_SEQUENCE, 0, 0);
}

/* A slot's number; -1 with an error set. */
static Py_ssize_t slot_argument(Ledger *ledger, PyObject *number) {
    const Py_ssize_t slot = PyLong_AsSsize_t(number);
    if (slot == -1 && PyErr_Occurred()) return -1;
    if (slot >= 0 && slot < ledger->slots) return slot;
    PyErr_Format(PyExc_IndexError, "slot %zd of %zd", slot, ledger->slots);
    return -1;
}

static int column_argument(PyObject *number) {
    const long column = PyLong_AsLong(number);
    if (column == -1 && PyErr_Occurred()) return -1;
    if (column >= 0 && column < COLUMNS) return (int)column;
    PyErr_Format(PyExc_IndexError, "column %ld of %d", column, COLUMNS);
    return -1;
}

static int arguments_are(Py_ssize_t count, Py_ssize_t wanted) {
    if (count == wanted) return 1;
    PyErr_Format(PyExc_TypeError, "expected %zd arguments, got %zd", wanted, count);
    return 0;
}

static PyObject *py_acquire(Ledger *ledger, PyObject *unused) {
    (void)unused;
    return PyLong_FromSsize_t(begin_writing(ledger));
}

static PyObject *py_commit(Ledger *ledger, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 4)) return NULL;
    const Py_ssize_t slot = slot_argument(ledger, arguments[0]);
    const uint64_t sequence = PyLong_AsUnsignedLongLong(arguments[1]);
    const Py_ssize_t size = PyLong_AsSsize_t(arguments[2]);
    const uint64_t mask = PyLong_AsUnsignedLongLong(arguments[3]);
    if (PyErr_Occurred()) return NULL;
    end_writing(ledger, slot, sequence, (uint64_t)size, mask);
    Py_RETURN_NONE;
}

static PyObject *py_abandon(Ledger *ledger, PyObject *number) {
    const Py_ssize_t slot = slot_argument(ledger, number);
    if (slot < 0) return NULL;
    ledger_abandon(ledger, slot);
    Py_RETURN_NONE;
}

static PyObject *py_is_writing(Ledger *ledger, PyObject *number) {
    const Py_ssize_t slot = slot_argument(ledger, number);
    return slot < 0 ? NULL : PyBool_FromLong(ledger->state[slot] & 1);
}

static PyObject *py_revoke(Ledger *ledger, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 2)) return NULL;
    const Py_ssize_t slot = slot_argument(ledger, arguments[0]);
    const uint64_t mask = PyLong_AsUnsignedLongLong(arguments[1]);
    if (PyErr_Occurred()) return NULL;
    for (uint64_t rest = ledger->closed ? 0 : mask; rest; rest &= rest - 1) {
        const int column = __builtin_ctzll(rest);
        __atomic_store_n(lease_byte(ledger->leases, slot, column), 0, __ATOMIC_RELEASE);
    }
    ledger->granted[slot] &= ~mask;
    Py_RETURN_NONE;
}

static PyObject *py_pin(Ledger *ledger, PyObject *number) {
    const Py_ssize_t slot = slot_argument(ledger, number);
    if (slot < 0) return NULL;
    ledger->busy[slot] += 1;
    Py_RETURN_NONE;
}

static PyObject *py_unpin(Ledger *ledger, PyObject *number) {
    const Py_ssize_t slot = slot_argument(ledger, number);
    if (slot < 0) return NULL;
    if (ledger->busy[slot]) ledger->busy[slot] -= 1;
    Py_RETURN_NONE;
}

static PyObject *py_outstanding(Ledger *ledger, PyObject *number) {
    const int column = column_argument(number);
    return column < 0 ? NULL : PyLong_FromSsize_t(outstanding(ledger, column));
}

static PyObject *py_has_room(Ledger *ledger, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 2)) return NULL;
    const int column = column_argument(arguments[0]);
    const Py_ssize_t quota = PyLong_AsSsize_t(arguments[1]);
    if (PyErr_Occurred()) return NULL;
    return PyBool_FromLong(has_room(ledger, column, quota));
}

static PyObject *py_free_column(Ledger *ledger, PyObject *number) {
    const int column = column_argument(number);
    if (column < 0) return NULL;
    for (Py_ssize_t slot = 0; slot < ledger->slots && !ledger->closed; ++slot) {
        /* Those not granted too: the next reader with this column shall find none. */
        __atomic_store_n(lease_byte(ledger->leases, slot, column), 0, __ATOMIC_RELEASE);
        ledger->granted[slot] &= ~(1ull << column);
    }
    ledger->held[column] = 0;
    Py_RETURN_NONE;
}

static PyObject *py_is_busy(Ledger *ledger, PyObject *unused) {
    (void)unused;
    for (Py_ssize_t slot = 0; slot < ledger->slots; ++slot) {
        if (ledger->busy[slot]) Py_RETURN_TRUE;
    }
    Py_RETURN_FALSE;
}

static PyObject *py_plan(Ledger *ledger, PyObject *grants) {
    if (!PyList_Check(grants)) {
        PyErr_SetString(PyExc_TypeError, "expected a list of columns and quotas");
        return NULL;
    }
    uint64_t mask = 0;
    for (Py_ssize_t index = 0; index < PyList_GET_SIZE(grants); ++index) {
        int column;
        Py_ssize_t quota;
        if (!PyArg_ParseTuple(PyList_GET_ITEM(grants, index), "in", &column, &quota)) return NULL;
        if (column < 0 || column >= COLUMNS) {
            PyErr_Format(PyExc_IndexError, "column %d of %d", column, COLUMNS);
            return NULL;
        }
        mask |= 1ull << column;
        ledger->quota[column] = quota;
    }
    ledger->mask = mask;
    if (ledger->turns < 0) ledger->turns = 0;
    Py_RETURN_NONE;
}

static PyObject *py_keep(Ledger *ledger, PyObject *unused) {
    (void)unused;
    if (ledger->turns >= 0) ledger->turns = ledger->slots;
    Py_RETURN_NONE;
}

void ledger_use(Ledger *ledger, int more) {
    ledger->users += more;
    if (ledger->closed && !ledger->users && ledger->memory.obj != NULL) PyBuffer_Release(&ledger->memory);
}

static PyObject *py_close(Ledger *ledger, PyObject *unused) {
    (void)unused;
    ledger->closed = 1;
    ledger_use(ledger, 0);
    for (Py_ssize_t slot = 0; slot < ledger->slots; ++slot) ledger->granted[slot] = 0;
    memset(ledger->held, 0, sizeof ledger->held);
    Py_RETURN_NONE;
}

static PyObject *ledger_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"memory", "slots", "slot_bytes", "leases", "headers", "first", "ring", "head", "place", NULL};
    PyObject *memory;
    Py_ssize_t slots, slot_bytes, leases, headers, first, head_size, place_size;
    unsigned int ring;
    const char *head, *place;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "OnnnnnIy#y#:Ledger", names, &memory, &slots, &slot_bytes, &leases,
                                     &headers, &first, &ring, &head, &head_size, &place, &place_size))
        return NULL;
    if (head_size != HEAD_SIZE || place_size != PLACE_SIZE || slots < 1 || slots > 4096 || slot_bytes < 1 || leases < 0
        || headers < 0 || first < 0) {
        PyErr_SetString(PyExc_ValueError, "no ring looks like this");
        return NULL;
    }
    Ledger *ledger = (Ledger *)type->tp_alloc(type, 0);
    if (ledger == NULL) return NULL;
    if (PyObject_GetBuffer(memory, &ledger->memory, PyBUF_WRITABLE) < 0) goto failed;
    const Py_ssize_t total = ledger->memory.len;
    if (leases + slots * COLUMNS > total || headers + slots * HEADER_WORDS * 8 > total || headers % 8
        || first > total || slot_bytes > (total - first) / slots) {
        PyErr_SetString(PyExc_ValueError, "the memory is smaller than the ring");
        goto failed;
    }
    ledger->slots = slots;
    ledger->slot_bytes = slot_bytes;
    ledger->leases = (uint8_t *)ledger->memory.buf + leases;
    ledger->headers = (uint64_t *)(void *)((char *)ledger->memory.buf + headers);
    ledger->first = (char *)ledger->memory.buf + first;
    ledger->ring = ring;
    ledger->last = slots - 1;
    ledger->turns = -1;
    memcpy(ledger->head, head, HEAD_SIZE);
    memcpy(ledger->place, place, PLACE_SIZE);
    ledger->state = PyMem_Calloc((size_t)slots, sizeof *ledger->state);
    ledger->granted = PyMem_Calloc((size_t)slots, sizeof *ledger->granted);
    ledger->written = PyMem_Calloc((size_t)slots, sizeof *ledger->written);
    ledger->busy = PyMem_Calloc((size_t)slots, sizeof *ledger->busy);
    if (!ledger->state || !ledger->granted || !ledger->written || !ledger->busy) {
        PyErr_NoMemory();
        goto failed;
    }
    return (PyObject *)ledger;
failed:
    Py_DECREF(ledger);
    return NULL;
}

static void ledger_dealloc(Ledger *ledger) {
    if (ledger->memory.obj != NULL) PyBuffer_Release(&ledger->memory);
    PyMem_Free(ledger->state);
    PyMem_Free(ledger->granted);
    PyMem_Free(ledger->written);
    PyMem_Free(ledger->busy);
    Py_TYPE(ledger)->tp_free((PyObject *)ledger);
}

static PyMethodDef ledger_methods[] = {
    {"acquire", (PyCFunction)py_acquire, METH_NOARGS, "A slot to write, or -1. After `plan` that which was written last."},
    {"commit", (PyCFunction)(void (*)(void))py_commit, METH_FASTCALL, "commit(slot, sequence, size, mask)"},
    {"abandon", (PyCFunction)py_abandon, METH_O, "abandon(slot)"},
    {"is_writing", (PyCFunction)py_is_writing, METH_O, "is_writing(slot)"},
    {"revoke", (PyCFunction)(void (*)(void))py_revoke, METH_FASTCALL, "revoke(slot, mask)"},
    {"pin", (PyCFunction)py_pin, METH_O, "pin(slot)"},
    {"unpin", (PyCFunction)py_unpin, METH_O, "unpin(slot)"},
    {"outstanding", (PyCFunction)py_outstanding, METH_O, "outstanding(column)"},
    {"has_room", (PyCFunction)(void (*)(void))py_has_room, METH_FASTCALL, "has_room(column, quota)"},
    {"free_column", (PyCFunction)py_free_column, METH_O, "free_column(column)"},
    {"is_busy", (PyCFunction)py_is_busy, METH_NOARGS, "Whether any slot is being written, or pinned."},
    {"plan", (PyCFunction)py_plan, METH_O, "plan(grants): column and quota of each reader that the short cut serves."},
    {"keep", (PyCFunction)py_keep, METH_NOARGS, "For as many messages as there are slots, write the oldest first."},
    {"close", (PyCFunction)py_close, METH_NOARGS, "Lend no slot any more."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject LedgerType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Ledger",
    .tp_doc = "Ledger(memory, slots, slot_bytes, leases, headers, first, ring, head, place)\n--\n\n"
              "The publisher's account of the slots of a ring; see `ledger.py`.",
    .tp_basicsize = sizeof(Ledger),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_new = ledger_new,
    .tp_dealloc = (destructor)ledger_dealloc,
    .tp_methods = ledger_methods,
};

Ledger *ledger_of(PyObject *object) { return Py_IS_TYPE(object, &LedgerType) ? (Ledger *)object : NULL; }

/* SlotView */

typedef struct {
    PyObject_HEAD
    Py_buffer head;      /* up to the slots, to read and write */
    Py_buffer memory;    /* the slots, to read */
    Py_buffer delivered; /* [slots] sequence of the message last leased from a slot; shared with `RingView` */
    Py_ssize_t slots, slot_bytes;
    uint8_t *leases;
    uint64_t *headers;
    uint32_t ring;
    int column;
} SlotView;

typedef struct {
    PyObject_HEAD
    SlotView *view;
    Py_ssize_t slot;
    uint64_t before; /* what `delivered` said */
} Lease;

static void lease_dealloc(Lease *lease) {
    if (lease->slot >= 0)
        __atomic_store_n(lease_byte(lease->view->leases, lease->slot, lease->view->column), 0, __ATOMIC_RELEASE);
    Py_XDECREF(lease->view);
    Py_TYPE(lease)->tp_free((PyObject *)lease);
}

static PyTypeObject LeaseType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Lease",
    .tp_doc = "The base of all arrays that look at one message; gives the slot back when it dies.",
    .tp_basicsize = sizeof(Lease),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .tp_dealloc = (destructor)lease_dealloc,
};

void cancel_lease(PyObject *object) {
    Lease *lease = (Lease *)object;
    ((uint64_t *)lease->view->delivered.buf)[lease->slot] = lease->before;
    lease->slot = -1;
    Py_DECREF(lease);
}

/* A new Lease, or NULL, without an error if the slot does not hold this message for us. */
static PyObject *lease_slot(SlotView *view, uint64_t slot, uint64_t sequence, uint64_t size) {
    if (slot >= (uint64_t)view->slots || size > (uint64_t)view->slot_bytes) return NULL;
    uint64_t *delivered = (uint64_t *)view->delivered.buf + slot;
    const uint64_t *header = view->headers + slot * HEADER_WORDS;
    const uint8_t *byte = lease_byte(view->leases, (Py_ssize_t)slot, view->column);
    if (__atomic_load_n(byte, __ATOMIC_ACQUIRE) != 1 || load_word(header + SEQUENCE) != sequence
        || load_word(header + SIZE) != size || *delivered == sequence)
        return NULL;
    Lease *lease = (Lease *)LeaseType.tp_alloc(&LeaseType, 0);
    if (lease == NULL) return NULL;
    lease->view = (SlotView *)Py_NewRef(view);
    lease->slot = (Py_ssize_t)slot;
    lease->before = *delivered;
    *delivered = sequence;
    return (PyObject *)lease;
}

static const char *slot_memory(SlotView *view, uint64_t slot) {
    return (const char *)view->memory.buf + (Py_ssize_t)slot * view->slot_bytes;
}

static PyTypeObject SlotViewType;

PyObject *take_lease(PyObject *object, const char *descriptor, const char **body, Py_ssize_t *size) {
    if (!Py_IS_TYPE(object, &SlotViewType)) return NULL;
    SlotView *view = (SlotView *)object;
    uint64_t rest[6];
    memcpy(rest, descriptor + HEAD_SIZE, sizeof rest);
    const uint64_t slot = rest[4] & UINT32_MAX;
    if (rest[4] >> 32 != view->ring || !(rest[5] >> view->column & 1)) return NULL;
    PyObject *lease = lease_slot(view, slot, rest[0], rest[3]);
    if (lease == NULL) return NULL;
    *body = slot_memory(view, slot);
    *size = (Py_ssize_t)rest[3];
    return lease;
}

PyDoc_STRVAR(lease_doc,
"lease($self, slot, sequence, size, /)\n--\n\n"
"The message in a slot as an array of bytes, read-only; None if the slot does not hold it for us.");

static PyObject *view_lease(SlotView *view, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 3)) return NULL;
    const uint64_t slot = PyLong_AsUnsignedLongLong(arguments[0]);
    const uint64_t sequence = PyLong_AsUnsignedLongLong(arguments[1]);
    const uint64_t size = PyLong_AsUnsignedLongLong(arguments[2]);
    if (PyErr_Occurred()) return NULL;
    PyObject *lease = lease_slot(view, slot, sequence, size);
    if (lease == NULL) {
        if (PyErr_Occurred()) return NULL;
        Py_RETURN_NONE;
    }
    npy_intp shape = (npy_intp)size;
    PyObject *array = PyArray_New(&PyArray_Type, 1, &shape, NPY_UINT8, NULL, (void *)slot_memory(view, slot), 0, 0, NULL);
    if (array == NULL) {
        Py_DECREF(lease);
        return NULL;
    }
    PyArray_CLEARFLAGS((PyArrayObject *)array, NPY_ARRAY_WRITEABLE);
    PyArray_UpdateFlags((PyArrayObject *)array, NPY_ARRAY_ALIGNED | NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_F_CONTIGUOUS);
    if (PyArray_SetBaseObject((PyArrayObject *)array, lease) < 0) { /* takes the lease in any case */
        Py_DECREF(array);
        return NULL;
    }
    return array;
}

static PyObject *slot_view_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"head", "memory", "delivered", "slots", "slot_bytes", "leases", "headers", "ring", "column", NULL};
    PyObject *head, *memory, *delivered;
    Py_ssize_t slots, slot_bytes, leases, headers;
    unsigned int ring;
    int column;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "OOOnnnnIi:SlotView", names, &head, &memory, &delivered, &slots,
                                     &slot_bytes, &leases, &headers, &ring, &column))
        return NULL;
    SlotView *view = (SlotView *)type->tp_alloc(type, 0);
    if (view == NULL) return NULL;
    if (PyObject_GetBuffer(head, &view->head, PyBUF_WRITABLE) < 0 || PyObject_GetBuffer(memory, &view->memory, PyBUF_SIMPLE) < 0
        || PyObject_GetBuffer(delivered, &view->delivered, PyBUF_WRITABLE) < 0)
        goto failed;
    if (slots < 1 || slots > 4096 || slot_bytes < 1 || leases < 0 || headers < 0 || headers % 8 || column < 0
        || column >= COLUMNS || leases + slots * COLUMNS > view->head.len
        || headers + slots * HEADER_WORDS * 8 > view->head.len || slot_bytes > view->memory.len / slots
        || view->delivered.len != slots * 8) {
        PyErr_SetString(PyExc_ValueError, "the memory is smaller than the ring");
        goto failed;
    }
    view->slots = slots;
    view->slot_bytes = slot_bytes;
    view->leases = (uint8_t *)view->head.buf + leases;
    view->headers = (uint64_t *)(void *)((char *)view->head.buf + headers);
    view->ring = ring;
    view->column = column;
    return (PyObject *)view;
failed:
    Py_DECREF(view);
    return NULL;
}

static void slot_view_dealloc(SlotView *view) {
    if (view->head.obj != NULL) PyBuffer_Release(&view->head);
    if (view->memory.obj != NULL) PyBuffer_Release(&view->memory);
    if (view->delivered.obj != NULL) PyBuffer_Release(&view->delivered);
    Py_TYPE(view)->tp_free((PyObject *)view);
}

static PyMethodDef slot_view_methods[] = {
    {"lease", (PyCFunction)(void (*)(void))view_lease, METH_FASTCALL, lease_doc},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject SlotViewType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.SlotView",
    .tp_doc = "SlotView(head, memory, delivered, slots, slot_bytes, leases, headers, ring, column)\n--\n\n"
              "A reader's side of a ring; see `RingView`.",
    .tp_basicsize = sizeof(SlotView),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_new = slot_view_new,
    .tp_dealloc = (destructor)slot_view_dealloc,
    .tp_methods = slot_view_methods,
};

int add_ring(PyObject *module) {
    PyTypeObject *types[] = {&LedgerType, &SlotViewType, &LeaseType};
    const char *names[] = {"Ledger", "SlotView", "Lease"};
    for (int index = 0; index < 3; ++index) {
        if (PyType_Ready(types[index]) < 0 || PyModule_AddObjectRef(module, names[index], (PyObject *)types[index]) < 0)
            return -1;
    }
    return 0;
}
