/* Bodies to messages, as `body.py` reads them, which also says what is wrong with a body.

   Another process may write to the bytes while they are read, against all rules: so every number is read once. */

#include "_coder.h"

#include <string.h>

/* A body being read. */
typedef struct {
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

static PyObject *read_member(const Members *members, const char *in) {
    int32_t number;
    memcpy(&number, in, 4);
    Py_ssize_t low = 0, high = members->count;
    while (low < high) {
        const Py_ssize_t middle = (low + high) / 2;
        const Member *member = &members->by_number[middle];
        if (member->number == number) return Py_NewRef(member->member);
        if (member->number < number) low = middle + 1;
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

static PyObject *unpack_fixed(const Body *body, const Array *known, Py_ssize_t at) {
    npy_intp shape[RANK_MAX];
    for (int axis = 0; axis < known->rank; ++axis) shape[axis] = known->axes[axis].size;
    return view_of(body, known->dtypes[0].descr, known->rank, shape, at);
}

static PyObject *unpack_variable(Body *body, const Array *known, Py_ssize_t at, npy_intp *dimensions) {
    uint32_t numbers[2 + RANK_MAX];
    memcpy(numbers, body->data + at, 4 * (size_t)(2 + known->rank));
    const uint32_t index = numbers[1] - known->head;
    if (index >= known->dtype_count) return NULL;
    const Dtype *dtype = &known->dtypes[index];
    npy_intp shape[RANK_MAX];
    Py_ssize_t bytes = dtype->itemsize; /* of the array as if no dimension were 0 */
    int is_empty = 0;
    for (int axis = 0; axis < known->rank; ++axis) {
        shape[axis] = numbers[2 + axis];
        if (!fits_axis(&known->axes[axis], shape[axis], dimensions)) return NULL;
        if (shape[axis] == 0) {
            is_empty = 1;
        } else {
            if (bytes > PY_SSIZE_T_MAX / shape[axis]) return NULL; /* NumPy refuses it, too */
            bytes *= shape[axis];
        }
    }
    if (!claim(body, numbers[0], is_empty ? 0 : bytes)) return NULL;
    return view_of(body, dtype->descr, known->rank, shape, numbers[0]);
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

static PyObject *unpack_list(Body *body, const List *list, Py_ssize_t at) {
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
        begin_scope(dimensions, list->dimension_count);
        PyObject *element = unpack_item(body, list->item, start + index * list->stride, dimensions);
        if (element == NULL) {
            Py_DECREF(elements);
            return NULL;
        }
        PyList_SET_ITEM(elements, index, element);
    }
    return elements;
}

static PyObject *unpack_message(Body *body, const Block *block, Py_ssize_t at) {
    PyObject *message = block->cls->tp_alloc(block->cls, 0);
    if (message == NULL) return NULL;
    npy_intp dimensions[DIMENSIONS_MAX];
    begin_scope(dimensions, block->dimension_count);
    const Item *end = block->fields + block->count;
    for (const Item *field = block->fields; field < end; ++field) {
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
    switch (item->kind) {
        case NUMBER:
            return read_number(item->code, in);
        case BOOL: {
            const unsigned char truth = (unsigned char)*in;
            return truth > 1 ? NULL : PyBool_FromLong(truth);
        }
        case ENUM:
            return read_member(&item->members, in);
        case FIXED:
            return unpack_fixed(body, &item->array, at);
        case VARIABLE:
            return unpack_variable(body, &item->array, at, dimensions);
        case STR:
        case BYTES:
            return unpack_text(body, item->kind, at);
        case OPTIONAL: {
            const unsigned char present = (unsigned char)*in;
            if (present > 1) return NULL;
            return present ? unpack_item(body, item->inner, at + item->inner->offset, dimensions) : Py_NewRef(Py_None);
        }
        case LIST:
            return unpack_list(body, &item->list, at);
        case MESSAGE:
            return unpack_message(body, &item->block, at);
    }
    Py_UNREACHABLE();
}

PyObject *read_body(const Coder *coder, PyObject *owner, const char *data, Py_ssize_t size) {
    const Block *block = &coder->block;
    if (size < block->size || size >= BODY_LIMIT || (size > block->size && !block->has_tail)) return NULL;
    Body body = {owner, data, size, size - block->size, VALUES_MAX};
    return unpack_message(&body, block, 0);
}
