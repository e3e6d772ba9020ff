/* Messages to bodies, as `body.py` writes them.

   The same walk is done twice, first to learn the size, then to write. Between the two others may have had the GIL, and
   may have changed a list: so the second checks that all goes where it was measured, and gives up if not. No Python code
   runs within a walk. */

#include "_coder.h"
#include "cpp/include/cortex/broadcast.h"

#include <string.h>

enum {
    LARGE_ARRAY_BYTES = 1024,
    DEFERRED_BYTES = 1 << 14,
};

static int pack_item(Pack *pack, const Item *item, PyObject *value, Py_ssize_t at, npy_intp *dimensions);

/* Numbers: each returns 0 if the value is not of the usual class or out of range, with no error set. */

/* Whether a value is a number of NumPy, of a class that has no Python code. */
#define IS_SCALAR(VALUE, CLASS) (PyArray_IsScalar(VALUE, CLASS) && !PyType_HasFeature(Py_TYPE(VALUE), Py_TPFLAGS_HEAPTYPE))

static int write_integer(char code, PyObject *value, char *out) {
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

static int write_float(char code, PyObject *value, char *out) {
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

static inline int write_number(char code, PyObject *value, char *out) {
    return code == 'd' || code == 'f' ? write_float(code, value, out) : write_integer(code, value, out);
}

static int write_bool(PyObject *value, char *out) {
    if (value != Py_True && value != Py_False && !PyArray_IsScalar(value, Bool)) return 0;
    *out = value == Py_True || (value != Py_False && PyObject_IsTrue(value));
    return 1;
}

static int write_member(const Table *table, const Item *item, PyObject *value, char *out) {
    int64_t low = item->first + item->count, high = low + item->count; /* behind those by number are those by address */
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        PyObject *member = object_of(table, &table->items[middle]);
        if (member == value) {
            const int32_t number = (int32_t)table->items[middle].code;
            memcpy(out, &number, 4);
            return 1;
        }
        if ((uintptr_t)member < (uintptr_t)value) low = middle + 1;
        else high = middle;
    }
    return 0;
}

/* The tail */

/* Make room in the tail: where so many bytes go, or -1. What is empty lies at 0. */
static Py_ssize_t claim(Pack *pack, Py_ssize_t size, Py_ssize_t alignment) {
    if (size == 0) return 0;
    const Py_ssize_t start = align_to(pack->end, alignment);
    if (start > pack->limit || size > pack->limit - start) return -1;
    if (pack->out != NULL) memset(pack->out + pack->end, 0, (size_t)(start - pack->end));
    pack->end = start + size;
    return start;
}

/* Write an offset and a second number, as begin the descriptors of all that lies in the tail. */
static void describe(const Pack *pack, Py_ssize_t at, Py_ssize_t start, Py_ssize_t second) {
    const uint32_t numbers[2] = {(uint32_t)start, (uint32_t)second};
    memcpy(pack->out + at, numbers, sizeof numbers);
}

static int pack_bytes(Pack *pack, const char *data, Py_ssize_t size, Py_ssize_t at) {
    const Py_ssize_t start = claim(pack, size, 8);
    if (start < 0) return 0;
    if (pack->out == NULL) return 1;
    describe(pack, at, start, size);
    if (size) memcpy(pack->out + start, data, (size_t)size);
    return 1;
}

static int pack_str(Pack *pack, PyObject *value, Py_ssize_t at) {
    if (!PyUnicode_CheckExact(value)) return 0;
    Py_ssize_t size;
    const char *data = PyUnicode_AsUTF8AndSize(value, &size);
    if (data != NULL) return pack_bytes(pack, data, size, at);
    PyErr_Clear();
    return 0;
}

/* Arrays */

/* Index of an array's dtype; -1 if the array is not of the usual class, of a right dtype and shape. */
static int64_t find_dtype(const Table *table, const Item *item, PyObject *value, npy_intp *dimensions) {
    if (!PyArray_CheckExact(value)) return -1;
    PyArrayObject *array = (PyArrayObject *)value;
    if (PyArray_NDIM(array) != item->count || !PyArray_IS_C_CONTIGUOUS(array)) return -1;
    const Item *axes = table->items + item->first, *dtypes = axes + item->count;
    const npy_intp *shape = PyArray_DIMS(array);
    for (int64_t axis = 0; axis < item->count; ++axis) {
        if (shape[axis] > UINT32_MAX || !fits_axis(&axes[axis], shape[axis], dimensions)) return -1;
    }
    const PyArray_Descr *descr = PyArray_DESCR(array);
    for (int64_t index = 0; index < item->dtypes; ++index) {
        if (descr_of(table, &dtypes[index]) == descr) return index;
    }
    return -1;
}

/* Whether an array lies just where it belongs: others are copied, without the GIL, and checked on the slow path. */
static int is_placed(const Pack *pack, PyArrayObject *array, Py_ssize_t start) {
    return PyArray_NBYTES(array) == 0 || PyArray_BYTES(array) == pack->place + start;
}

/* Copy the items of an array to where they belong, or leave that for later. */
static void put_items(Pack *pack, PyArrayObject *array, Py_ssize_t start) {
    const Py_ssize_t size = PyArray_NBYTES(array);
    if (PyArray_BYTES(array) == pack->out + start) return;
    if (pack->defers && size >= DEFERRED_BYTES && pack->deferred_count < DEFERRED_MAX) {
        pack->deferred[pack->deferred_count++] = (Deferred){(PyObject *)array, PyArray_BYTES(array), start, size};
    } else if (size) {
        memcpy(pack->out + start, PyArray_BYTES(array), (size_t)size);
    }
}

static int pack_variable(Pack *pack, const Item *item, PyObject *value, Py_ssize_t at, npy_intp *dimensions) {
    const int64_t dtype = find_dtype(pack->table, item, value, dimensions);
    if (dtype < 0) return 0;
    PyArrayObject *array = (PyArrayObject *)value;
    const Py_ssize_t size = PyArray_NBYTES(array);
    const Py_ssize_t start = claim(pack, size, size >= LARGE_ARRAY_BYTES ? 64 : 8);
    if (start < 0) return 0;
    if (pack->out == NULL) return pack->place == NULL || is_placed(pack, array, start);
    describe(pack, at, start, item->code + dtype);
    for (int axis = 0; axis < item->count; ++axis) {
        const uint32_t length = (uint32_t)PyArray_DIM(array, axis);
        memcpy(pack->out + at + 8 + 4 * axis, &length, 4);
    }
    put_items(pack, array, start);
    return 1;
}

static int pack_fixed(Pack *pack, const Item *item, PyObject *value, Py_ssize_t at, npy_intp *dimensions) {
    if (find_dtype(pack->table, item, value, dimensions) < 0) return 0;
    put_items(pack, (PyArrayObject *)value, at);
    return 1;
}

/* What has others within */

static int pack_list(Pack *pack, const Item *list, PyObject *value, Py_ssize_t at) {
    const Item *item = pack->table->items + list->first;
    if (!PyList_CheckExact(value) && !PyTuple_CheckExact(value)) return 0;
    const Py_ssize_t count = PySequence_Fast_GET_SIZE(value);
    if (count > pack->values_left / list->values) return 0;
    pack->values_left -= count * list->values;
    const Py_ssize_t start = claim(pack, count * list->stride, list->alignment);
    if (start < 0) return 0;
    if (pack->out != NULL) {
        describe(pack, at, start, count);
        memset(pack->out + start, 0, (size_t)(count * list->stride));
    } else if (!item->has_tail) {
        return 1;
    }
    PyObject **elements = PySequence_Fast_ITEMS(value);
    npy_intp dimensions[DIMENSIONS_MAX];
    for (Py_ssize_t index = 0; index < count; ++index) {
        begin_scope(dimensions, list->scope);
        if (!pack_item(pack, item, elements[index], start + index * list->stride, dimensions)) return 0;
    }
    return 1;
}

static int is_of_class(const Table *table, const Item *item, PyObject *message) {
    return (PyObject *)Py_TYPE(message) == object_of(table, item);
}

static int pack_message(Pack *pack, const Item *item, PyObject *message, Py_ssize_t at) {
    if (!is_of_class(pack->table, item, message)) return 0;
    npy_intp dimensions[DIMENSIONS_MAX];
    begin_scope(dimensions, item->scope);
    const Item *field = pack->table->items + item->first, *end = field + item->count;
    for (; field < end; ++field) {
        if (pack->out == NULL && !field->has_tail) continue;
        PyObject *value = *place_of(field, message);
        if (value == NULL || !pack_item(pack, field, value, at + field->offset, dimensions)) return 0;
    }
    return 1;
}

/* Put a value whose block is at `at` and has been filled with zeros; 0 without error if it is not as usual. */
static int pack_item(Pack *pack, const Item *item, PyObject *value, Py_ssize_t at, npy_intp *dimensions) {
    switch ((Kind)item->kind) {
        case NUMBER:
            return write_number((char)item->code, value, pack->out + at);
        case BOOL:
            return write_bool(value, pack->out + at);
        case ENUM:
            return write_member(pack->table, item, value, pack->out + at);
        case FIXED:
            return pack_fixed(pack, item, value, at, dimensions);
        case VARIABLE:
            return pack_variable(pack, item, value, at, dimensions);
        case STR:
            return pack_str(pack, value, at);
        case BYTES:
            return PyBytes_CheckExact(value) && pack_bytes(pack, PyBytes_AS_STRING(value), PyBytes_GET_SIZE(value), at);
        case OPTIONAL: {
            const Item *inner = pack->table->items + item->first;
            if (value == Py_None) return 1;
            if (pack->out != NULL) pack->out[at] = 1;
            return pack_item(pack, inner, value, at + inner->offset, dimensions);
        }
        case LIST:
            return pack_list(pack, item, value, at);
        case MESSAGE:
            return pack_message(pack, item, value, at);
        case DIMENSION:
        case DTYPE:
        case MEMBER:
            break;
    }
    Py_UNREACHABLE();
}

/* Bodies */

static void begin_pack(Pack *pack, const Coder *coder, char *out, const char *place, Py_ssize_t limit) {
    pack->table = &coder->table;
    pack->out = out;
    pack->end = coder->table.items->size;
    pack->limit = limit < BODY_LIMIT ? limit : BODY_LIMIT - 1;
    pack->place = place;
    pack->values_left = VALUES_MAX;
}

Py_ssize_t measure_body(const Coder *coder, PyObject *message) {
    const Item *outermost = coder->table.items;
    if (!outermost->has_tail) return is_of_class(&coder->table, outermost, message) ? outermost->size : -1;
    Pack pack;
    begin_pack(&pack, coder, NULL, NULL, BODY_LIMIT);
    return pack_message(&pack, outermost, message, 0) ? pack.end : -1;
}

Py_ssize_t measure_in_place(const Coder *coder, PyObject *message, const char *place, Py_ssize_t room) {
    const Item *outermost = coder->table.items;
    Pack pack;
    begin_pack(&pack, coder, NULL, place, room);
    return outermost->has_tail && outermost->size <= room && pack_message(&pack, outermost, message, 0) ? pack.end : -1;
}

int write_body(const Coder *coder, PyObject *message, Pack *pack, char *out, Py_ssize_t size, int defers) {
    const Item *outermost = coder->table.items;
    begin_pack(pack, coder, out, NULL, size);
    pack->stamp_ns = 0;
    pack->defers = defers;
    pack->deferred_count = 0;
    memset(out, 0, (size_t)outermost->size);
    if (!pack_message(pack, outermost, message, 0) || pack->end != size) return 0;
    if (coder->stamp < 0) return 1;
    pack->stamp_ns = PyLong_AsLongLong(*place_of(&coder->table.items[coder->stamp], message)); /* it was written */
    if (pack->stamp_ns != -1 || !PyErr_Occurred()) return 1;
    PyErr_Clear();
    return 0;
}

void copy_deferred(const Pack *pack) {
    for (int index = 0; index < pack->deferred_count; ++index) {
        const Deferred *deferred = &pack->deferred[index];
        cortex_copy(pack->out + deferred->start, deferred->data, (size_t)deferred->size);
    }
}

void hold_deferred(const Pack *pack, int hold) {
    for (int index = 0; index < pack->deferred_count; ++index) {
        if (hold < 0) Py_DECREF(pack->deferred[index].array);
        else Py_INCREF(pack->deferred[index].array);
    }
}
