/* Bodies to messages, as `body.py` reads them, which also says what is wrong with a body.

   Another process may write to the bytes while they are read, against all rules: so every number is read once. */

#include "_coder.h"

#include <string.h>

/* A body being read. */
typedef struct {
    const Table *table;
    PyObject *owner; /* of its memory */
    const char *data;
    Py_ssize_t size;
    Py_ssize_t left; /* bytes that items may still take up, as in `body.py` */
    Py_ssize_t values_left;
} Body;

static PyObject *unpack_item(Body *body, const Item *item, Py_ssize_t at, npy_intp *dimensions);

static PyObject *read_number(char code, const char *in) {
#define NUMBER_OF(CODE, TYPE, MAKE) \
    case CODE: { \
        TYPE number; \
        memcpy(&number, in, sizeof number); \
        return MAKE(number); \
    }
    switch (code) {
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
    Py_UNREACHABLE();
}

static PyObject *read_member(const Table *table, const Item *item, const char *in) {
    int32_t number;
    memcpy(&number, in, 4);
    int64_t low = item->first, high = low + item->count;
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        const Item *member = &table->items[middle];
        if (member->code == number) return Py_NewRef(object_of(table, member));
        if (member->code < number) low = middle + 1;
        else high = middle;
    }
    return NULL;
}

/* Whether an item may lie there; then those bytes are taken. */
static int claim(Body *body, Py_ssize_t start, Py_ssize_t size) {
    body->left -= size;
    return body->left >= 0 && start <= body->size && size <= body->size - start;
}

/* A read-only view of an array's bytes. */
static PyObject *view_of(const Body *body, PyArray_Descr *descr, int rank, const npy_intp *shape, Py_ssize_t start) {
    Py_INCREF(descr);
    PyObject *array = PyArray_NewFromDescr(
        &PyArray_Type, descr, rank, shape, NULL, (void *)(body->data + start), 0, NULL);
    if (array == NULL) return NULL;
    if (PyArray_SetBaseObject((PyArrayObject *)array, Py_NewRef(body->owner)) < 0) { /* takes it in any case */
        Py_DECREF(array);
        return NULL;
    }
    PyArray_UpdateFlags((PyArrayObject *)array, NPY_ARRAY_ALIGNED | NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_F_CONTIGUOUS);
    return array;
}

static PyObject *unpack_fixed(const Body *body, const Item *item, Py_ssize_t at) {
    const Item *axes = body->table->items + item->first;
    npy_intp shape[RANK_MAX];
    for (int64_t axis = 0; axis < item->count; ++axis) shape[axis] = axes[axis].size;
    return view_of(body, descr_of(body->table, &axes[item->count]), (int)item->count, shape, at);
}

static PyObject *unpack_variable(Body *body, const Item *item, Py_ssize_t at, npy_intp *dimensions) {
    const Item *axes = body->table->items + item->first;
    uint32_t numbers[2 + RANK_MAX];
    memcpy(numbers, body->data + at, 4 * (size_t)(2 + item->count));
    const uint32_t index = numbers[1] - (uint32_t)item->code;
    if (index >= item->dtypes) return NULL;
    const Item *dtype = axes + item->count + index;
    npy_intp shape[RANK_MAX];
    Py_ssize_t bytes = dtype->size; /* of the array as if no dimension were 0 */
    int is_empty = 0;
    for (int64_t axis = 0; axis < item->count; ++axis) {
        shape[axis] = numbers[2 + axis];
        if (!fits_axis(&axes[axis], shape[axis], dimensions)) return NULL;
        if (shape[axis] == 0) {
            is_empty = 1;
        } else {
            if (bytes > PY_SSIZE_T_MAX / shape[axis]) return NULL; /* NumPy refuses it, too */
            bytes *= shape[axis];
        }
    }
    if (!claim(body, numbers[0], is_empty ? 0 : bytes)) return NULL;
    return view_of(body, descr_of(body->table, dtype), (int)item->count, shape, numbers[0]);
}

/* A str, or bytes. */
static PyObject *unpack_text(Body *body, Kind kind, Py_ssize_t at) {
    uint32_t numbers[2];
    memcpy(numbers, body->data + at, sizeof numbers);
    if (!claim(body, numbers[0], numbers[1])) return NULL;
    const char *data = body->data + numbers[0];
    if (kind == BYTES) return PyBytes_FromStringAndSize(data, numbers[1]);
    PyObject *text = PyUnicode_DecodeUTF8(data, numbers[1], NULL);
    if (text == NULL && PyErr_ExceptionMatches(PyExc_UnicodeDecodeError)) PyErr_Clear();
    return text;
}

static PyObject *unpack_list(Body *body, const Item *list, Py_ssize_t at) {
    const Item *item = body->table->items + list->first;
    uint32_t numbers[2];
    memcpy(numbers, body->data + at, sizeof numbers);
    const Py_ssize_t start = numbers[0], count = numbers[1];
    if (count > body->values_left / list->values) return NULL;
    body->values_left -= count * list->values;
    if (!claim(body, start, count * list->stride)) return NULL;
    PyObject *elements = PyList_New(count);
    if (elements == NULL) return NULL;
    npy_intp dimensions[DIMENSIONS_MAX];
    for (Py_ssize_t index = 0; index < count; ++index) {
        begin_scope(dimensions, list->scope);
        PyObject *element = unpack_item(body, item, start + index * list->stride, dimensions);
        if (element == NULL) {
            Py_DECREF(elements);
            return NULL;
        }
        PyList_SET_ITEM(elements, index, element);
    }
    return elements;
}

static PyObject *unpack_message(Body *body, const Item *item, Py_ssize_t at) {
    PyTypeObject *cls = (PyTypeObject *)object_of(body->table, item);
    PyObject *message = cls->tp_alloc(cls, 0);
    if (message == NULL) return NULL;
    npy_intp dimensions[DIMENSIONS_MAX];
    begin_scope(dimensions, item->scope);
    const Item *field = body->table->items + item->first, *end = field + item->count;
    for (; field < end; ++field) {
        PyObject *value = unpack_item(body, field, at + field->offset, dimensions);
        if (value == NULL) {
            Py_DECREF(message);
            return NULL;
        }
        *place_of(field, message) = value;
    }
    return message;
}

/* The value whose block is at `at`; NULL without error if the body is malformed. */
static PyObject *unpack_item(Body *body, const Item *item, Py_ssize_t at, npy_intp *dimensions) {
    const char *in = body->data + at;
    switch ((Kind)item->kind) {
        case NUMBER:
            return read_number((char)item->code, in);
        case BOOL: {
            const unsigned char truth = (unsigned char)*in;
            return truth > 1 ? NULL : PyBool_FromLong(truth);
        }
        case ENUM:
            return read_member(body->table, item, in);
        case FIXED:
            return unpack_fixed(body, item, at);
        case VARIABLE:
            return unpack_variable(body, item, at, dimensions);
        case STR:
        case BYTES:
            return unpack_text(body, (Kind)item->kind, at);
        case OPTIONAL: {
            const unsigned char present = (unsigned char)*in;
            const Item *inner = body->table->items + item->first;
            if (present > 1) return NULL;
            return present ? unpack_item(body, inner, at + inner->offset, dimensions) : Py_NewRef(Py_None);
        }
        case LIST:
            return unpack_list(body, item, at);
        case MESSAGE:
            return unpack_message(body, item, at);
        case DIMENSION:
        case DTYPE:
        case MEMBER:
            break;
    }
    Py_UNREACHABLE();
}

PyObject *read_body(const Coder *coder, PyObject *owner, const char *data, Py_ssize_t size) {
    const Item *outermost = coder->table.items;
    if (size < outermost->size || size >= BODY_LIMIT || (size > outermost->size && !outermost->has_tail)) return NULL;
    Body body = {&coder->table, owner, data, size, size - outermost->size, VALUES_MAX};
    return unpack_message(&body, outermost, 0);
}
