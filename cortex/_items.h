/* What is known in advance of the values of a type, as WIRE.md, section 5.1, lays them out: a table that `native.py` makes. */

#ifndef CORTEX_ITEMS_H
#define CORTEX_ITEMS_H

#include "_native.h"
#include "_numpy.h"

enum {
    RANK_MAX = 32,
    VALUES_MAX = 1 << 20, /* objects that the elements of all lists of a body become */
    DIMENSIONS_MAX = 64, /* named dimensions that must agree, in one scope */
};
static const Py_ssize_t BODY_LIMIT = (Py_ssize_t)1 << 32;

typedef enum { NUMBER, BOOL, ENUM, FIXED, VARIABLE, STR, BYTES, OPTIONAL, LIST, MESSAGE, DIMENSION, DTYPE, MEMBER } Kind;

/* A value of one type: a field, what is optional, an element of a list; or something that such a value has. As `Row` in
   `native.py`, which says what the numbers are. */
typedef struct {
    int64_t kind, code, has_tail, slot, offset, size, first, count, object, scope, stride, alignment, values, dtypes;
} Item;

/* All rows of a message, of which the first is the outermost, and the classes, dtypes and members that they name. */
typedef struct {
    PyObject *rows, *objects; /* bytes and a tuple, which are kept */
    const Item *items;
} Table;

static inline PyObject *object_of(const Table *table, const Item *item) { return PyTuple_GET_ITEM(table->objects, item->object); }

static inline PyArray_Descr *descr_of(const Table *table, const Item *dtype) {
    return (PyArray_Descr *)object_of(table, dtype);
}

static inline PyObject **place_of(const Item *field, PyObject *message) {
    return (PyObject **)((char *)message + field->slot);
}

static inline void begin_scope(npy_intp *dimensions, int64_t count) {
    for (int64_t name = 0; name < count; ++name) dimensions[name] = -1;
}

/* Whether an axis may have so many items; notes it where others must agree. */
static inline int fits_axis(const Item *axis, npy_intp size, npy_intp *dimensions) {
    if (axis->size >= 0 && axis->size != size) return 0;
    if (axis->scope < 0) return 1;
    if (dimensions[axis->scope] < 0) dimensions[axis->scope] = size;
    return dimensions[axis->scope] == size;
}

#endif
