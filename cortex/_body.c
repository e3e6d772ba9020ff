/* How messages of Python hold their values, for the walk of `body_walk.h`; bodies as `body.py` writes and reads them, which also says
   what is wrong with one.

   A message is walked twice, first to learn its size, then to write it. Between the two others may have had the GIL, and may have
   changed a list: so the second checks that all goes where it was measured, and gives up if not. No Python code runs within a walk.
   What a walk refuses it refuses without an error set, unless there was no memory. */

#include "_coder.h"
#include "cpp/include/cortex/body_walk.h"
#include "cpp/include/cortex/broadcast.h"

enum { DEFERRED_BYTES = 1 << 14 };

/* The value at a place; one that nothing takes, if there is none. */
static inline PyObject *value_at(const char *place) {
    PyObject *value = *(PyObject *const *)(const void *)place;
    return value == NULL ? Py_NotImplemented : value;
}

static inline int put_value(char *place, PyObject *value) {
    *(PyObject **)(void *)place = value;
    return value != NULL;
}

/* Numbers: each returns 0 if the value is not of the usual class or out of range, with no error set. */

/* Whether a value is a number of NumPy, of a class that has no Python code. */
#define IS_SCALAR(VALUE, CLASS) (PyArray_IsScalar(VALUE, CLASS) && !PyType_HasFeature(Py_TYPE(VALUE), Py_TPFLAGS_HEAPTYPE))

static int write_integer(int64_t code, PyObject *value, uint8_t *out) {
    if (!PyLong_Check(value)) {
        if (!IS_SCALAR(value, Integer)) return 0;
        PyObject *number = PyNumber_Index(value);
        const int written = number != NULL && write_integer(code, number, out);
        Py_XDECREF(number);
        PyErr_Clear();
        return written;
    }
    if (code == 'Q') {
        const uint64_t number = PyLong_AsUnsignedLongLong(value);
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

static int write_float(int64_t code, PyObject *value, uint8_t *out) {
    const int is_usual = PyFloat_Check(value) || PyLong_CheckExact(value) || IS_SCALAR(value, Floating)
        || IS_SCALAR(value, Integer);
    if (!is_usual) return 0;
    const double number = PyFloat_AsDouble(value);
    if (number == -1.0 && PyErr_Occurred()) {
        PyErr_Clear();
        return 0;
    }
    if (code == 'd') {
        memcpy(out, &number, 8);
        return 1;
    }
    const float narrow = (float)number;
    if (narrow - narrow != 0.0f && number - number == 0.0) return 0; /* too large for a float32 */
    memcpy(out, &narrow, 4);
    return 1;
}

static int write_bool(PyObject *value, uint8_t *out) {
    if (value != Py_True && value != Py_False && !PyArray_IsScalar(value, Bool)) return 0;
    *out = value == Py_True || (value != Py_False && PyObject_IsTrue(value));
    return 1;
}

/* Members lie once more behind those by number, by address. */
static int write_member(const CortexItem *items, const CortexItem *item, PyObject *value, uint8_t *out) {
    int64_t low = item->first + item->count, high = low + item->count;
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (items[middle].object == value) {
            const int32_t number = (int32_t)items[middle].code;
            memcpy(out, &number, 4);
            return 1;
        }
        if ((uintptr_t)items[middle].object < (uintptr_t)value) low = middle + 1;
        else high = middle;
    }
    return 0;
}

static inline int cortex_get_scalar(CortexWrite *write, const CortexItem *item, const char *place, uint8_t *out) {
    PyObject *value = value_at(place);
    if (item->kind == CORTEX_ENUM) return write_member(write->items, item, value, out);
    if (item->kind == CORTEX_BOOL) return write_bool(value, out);
    return item->code == 'd' || item->code == 'f' ? write_float(item->code, value, out) : write_integer(item->code, value, out);
}

/* What has a size of its own */

static inline int cortex_get_text(CortexWrite *write, const CortexItem *item, const char *place, const void **data, uint64_t *size) {
    (void)write;
    PyObject *value = value_at(place);
    Py_ssize_t bytes;
    if (item->kind == CORTEX_BYTES && PyBytes_CheckExact(value)) {
        *data = PyBytes_AS_STRING(value);
        bytes = PyBytes_GET_SIZE(value);
    } else if (item->kind == CORTEX_STR && PyUnicode_CheckExact(value)) {
        *data = PyUnicode_AsUTF8AndSize(value, &bytes);
        if (*data == NULL) PyErr_Clear();
    } else {
        return 0;
    }
    *size = (uint64_t)bytes;
    return *data != NULL;
}

/* An array of the usual class, of a right dtype and rank. */
static inline int cortex_get_array(CortexWrite *write, const CortexItem *item, const char *place, CortexArray *found) {
    PyArrayObject *array = (PyArrayObject *)value_at(place);
    if (!PyArray_CheckExact(array) || PyArray_NDIM(array) != item->count || !PyArray_IS_C_CONTIGUOUS(array)) return 0;
    const CortexItem *dtypes = write->items + item->first + item->count;
    for (found->dtype = 0; found->dtype < item->dtypes; ++found->dtype)
        if (dtypes[found->dtype].object == PyArray_DESCR(array)) break;
    if (found->dtype == item->dtypes) return 0;
    for (int axis = 0; axis < PyArray_NDIM(array); ++axis) found->shape[axis] = PyArray_DIM(array, axis);
    found->data = PyArray_BYTES(array);
    found->bytes = (uint64_t)PyArray_NBYTES(array);
    return 1;
}

/* Copy the items of an array to where they belong, or leave that for later. While it is measured for a place, whether it lies just
   there: others are copied, without the GIL, and checked on the slow path. */
static inline int cortex_copy_array(CortexWrite *write, const CortexArray *array, const char *place, uint64_t start) {
    Pack *pack = (Pack *)write;
    if (write->out == NULL) return pack->place == NULL || array->data == pack->place + start;
    if (array->data == write->out + start) return 1;
    if (pack->defers && array->bytes >= DEFERRED_BYTES && pack->deferred_count < DEFERRED_MAX) {
        pack->deferred[pack->deferred_count++] = (Deferred){value_at(place), array->data, start, array->bytes};
    } else {
        memcpy(write->out + start, array->data, (size_t)array->bytes);
    }
    return 1;
}

/* What has others within */

static inline const char *cortex_get_optional(CortexWrite *write, const CortexItem *item, const char *place) {
    (void)write, (void)item;
    return value_at(place) == Py_None ? NULL : place;
}

static inline int cortex_get_list(
    CortexWrite *write, const CortexItem *item, const char *place, uint64_t *count, const char **elements, size_t *step) {
    (void)write, (void)item;
    PyObject *value = value_at(place);
    if (!PyList_CheckExact(value) && !PyTuple_CheckExact(value)) return 0;
    *count = (uint64_t)PySequence_Fast_GET_SIZE(value);
    *elements = (const char *)PySequence_Fast_ITEMS(value);
    *step = sizeof(PyObject *);
    return 1;
}

static inline const char *cortex_get_message(CortexWrite *write, const CortexItem *item, const char *place) {
    (void)write;
    PyObject *value = value_at(place);
    return (const void *)Py_TYPE(value) == item->object ? (const char *)value : NULL;
}

/* Bodies */

static Py_ssize_t measure(const Coder *coder, PyObject *message, const char *place, Py_ssize_t room) {
    Pack pack;
    pack.place = place;
    return cortex_write_body(&pack.write, coder->items, NULL, 0, (uint64_t)room, (char *)&message) ? (Py_ssize_t)pack.write.end : -1;
}

Py_ssize_t measure_body(const Coder *coder, PyObject *message) {
    if (coder->items->has_tail) return measure(coder, message, NULL, BODY_LIMIT);
    return (const void *)Py_TYPE(message) == coder->items->object ? (Py_ssize_t)coder->items->size : -1;
}

Py_ssize_t measure_in_place(const Coder *coder, PyObject *message, const char *place, Py_ssize_t room) {
    return coder->items->has_tail ? measure(coder, message, place, room) : -1;
}

int write_body(const Coder *coder, PyObject *message, Pack *pack, char *out, Py_ssize_t size, int defers) {
    pack->stamp_ns = 0;
    pack->defers = defers;
    pack->deferred_count = 0;
    if (!cortex_write_body(&pack->write, coder->items, (uint8_t *)out, 0, (uint64_t)size, (char *)&message)
        || pack->write.end != (uint64_t)size)
        return 0;
    if (coder->stamp < 0) return 1;
    pack->stamp_ns = PyLong_AsLongLong(value_at((char *)message + coder->items[coder->stamp].place)); /* it was written */
    if (pack->stamp_ns != -1 || !PyErr_Occurred()) return 1;
    PyErr_Clear();
    return 0;
}

void copy_deferred(const Pack *pack) {
    for (int index = 0; index < pack->deferred_count; ++index) {
        const Deferred *deferred = &pack->deferred[index];
        cortex_copy(pack->write.out + deferred->start, deferred->data, (size_t)deferred->size);
    }
}

void hold_deferred(const Pack *pack, int hold) {
    for (int index = 0; index < pack->deferred_count; ++index) {
        if (hold < 0) Py_DECREF(pack->deferred[index].array);
        else Py_INCREF(pack->deferred[index].array);
    }
}

/* Reading: each puts a new object at its place */

static inline int cortex_put_number(CortexRead *read, const CortexItem *item, const uint8_t *in, char *place) {
    (void)read;
#define NUMBER_OF(CODE, TYPE, MAKE) \
    case CODE: { \
        TYPE number; \
        memcpy(&number, in, sizeof number); \
        return put_value(place, MAKE(number)); \
    }
    switch (item->code) {
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
    return 0;
}

static inline int cortex_put_bool(CortexRead *read, int truth, char *place) { return (void)read, put_value(place, PyBool_FromLong(truth)); }

static inline int cortex_put_member(CortexRead *read, const CortexItem *member, char *place) {
    (void)read;
    return put_value(place, Py_NewRef((PyObject *)(uintptr_t)member->object));
}

static inline int cortex_put_text(CortexRead *read, const CortexItem *item, const uint8_t *in, uint64_t size, char *place) {
    (void)read;
    const char *data = (const char *)in;
    if (item->kind == CORTEX_BYTES) return put_value(place, PyBytes_FromStringAndSize(data, (Py_ssize_t)size));
    PyObject *text = PyUnicode_DecodeUTF8(data, (Py_ssize_t)size, NULL);
    if (text == NULL && PyErr_ExceptionMatches(PyExc_UnicodeDecodeError)) PyErr_Clear();
    return put_value(place, text);
}

/* A read-only view of the bytes. */
static inline int cortex_put_array(CortexRead *read, const CortexItem *item, const CortexArray *array, char *place) {
    PyObject *descr = (PyObject *)(uintptr_t)read->items[item->first + item->count + array->dtype].object;
    npy_intp shape[CORTEX_RANK];
    for (int64_t axis = 0; axis < item->count; ++axis) shape[axis] = array->shape[axis];
    PyObject *view = PyArray_NewFromDescr(&PyArray_Type, (PyArray_Descr *)Py_NewRef(descr), (int)item->count, shape, NULL,
                                          (void *)(uintptr_t)array->data, 0, NULL);
    if (!put_value(place, view)) return 0;
    if (PyArray_SetBaseObject((PyArrayObject *)view, Py_NewRef((PyObject *)read->owner)) < 0) return 0; /* takes it in any case */
    PyArray_UpdateFlags((PyArrayObject *)view, NPY_ARRAY_ALIGNED | NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_F_CONTIGUOUS);
    return 1;
}

static inline char *cortex_put_optional(CortexRead *read, const CortexItem *item, int present, char *place) {
    (void)read, (void)item;
    if (!present) put_value(place, Py_NewRef(Py_None));
    return place;
}

static inline int cortex_put_list(CortexRead *read, const CortexItem *item, uint64_t count, char *place, char **elements, size_t *step) {
    (void)read, (void)item;
    PyObject *list = PyList_New((Py_ssize_t)count);
    if (!put_value(place, list)) return 0;
    *elements = (char *)PySequence_Fast_ITEMS(list);
    *step = sizeof(PyObject *);
    return 1;
}

static inline char *cortex_put_message(CortexRead *read, const CortexItem *item, char *place) {
    (void)read;
    PyTypeObject *cls = (PyTypeObject *)(uintptr_t)item->object;
    PyObject *message = cls->tp_alloc(cls, 0);
    put_value(place, message);
    return (char *)message;
}

PyObject *read_body(const Coder *coder, PyObject *owner, const char *data, Py_ssize_t size) {
    PyObject *message = NULL;
    CortexRead read;
    if (!cortex_read_body(&read, coder->items, data, (uint64_t)size, owner, (char *)&message)) Py_CLEAR(message);
    return message;
}
