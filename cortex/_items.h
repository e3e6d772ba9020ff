/* What is known in advance of the fields of a message, as WIRE.md, section 5.1, lays them out. */

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

/* As in `native.py`. */
typedef enum { NUMBER, BOOL, ENUM, FIXED, VARIABLE, STR, BYTES, OPTIONAL, LIST, MESSAGE } Kind;

typedef struct Item Item;

typedef struct {
    PyArray_Descr *descr;
    Py_ssize_t itemsize;
} Dtype;

typedef struct {
    npy_intp size; /* -1: any */
    int name;      /* number of the named dimension that must agree, -1: none */
} Axis;

typedef struct {
    Py_ssize_t dtype_count; /* 1, or more if it is open */
    Dtype *dtypes;
    int rank;
    Axis *axes;
    uint32_t head; /* VARIABLE: second number of the descriptor, less the index of the dtype */
} Array;

typedef struct {
    int32_t number;
    PyObject *member;
} Member;

typedef struct {
    Py_ssize_t count;
    Member *by_number, *by_member; /* sorted by the one, and by the address of the other */
} Members;

typedef struct {
    Item *item;
    Py_ssize_t stride, alignment;
    Py_ssize_t values; /* objects that an element becomes */
    int dimension_count; /* of the scope that each element is */
} List;

typedef struct Memory Memory;
struct Memory {
    Memory *before;
    max_align_t content[];
};

/* Of a message: where its fields lie. Of the outermost one also what keeps all this. */
typedef struct {
    PyObject *row; /* a tuple of tuples, which has all the classes, members and dtypes */
    Memory *memory;
    PyTypeObject *cls;
    Py_ssize_t size;
    int dimension_count;
    int has_tail;
    Py_ssize_t count;
    Item *fields;
} Block;

/* A value of one type: a field, what is optional, or an element of a list. */
struct Item {
    Kind kind;
    char code;         /* NUMBER: that of the struct module */
    char has_tail;     /* whether any of it lies outside of the block */
    Py_ssize_t slot;   /* fields: where the message object keeps it */
    Py_ssize_t offset; /* in the block of what it is part of */
    Py_ssize_t size;   /* in the block */
    union {
        Array array;     /* FIXED, VARIABLE */
        Members members; /* ENUM */
        Item *inner;     /* OPTIONAL */
        List list;
        Block block; /* MESSAGE */
    };
};

/* Take what `native.py` says of a message, see there; 0 with an error set. Whatever was taken is to be freed. */
int take_block(Block *block, PyObject *row);
void free_block(Block *block);

static inline PyObject **place_of(const Item *field, PyObject *message) {
    return (PyObject **)((char *)message + field->slot);
}

static inline void begin_scope(npy_intp *dimensions, int count) {
    for (int name = 0; name < count; ++name) dimensions[name] = -1;
}

/* Whether an axis may have so many items; notes it where others must agree. */
static inline int fits_axis(const Axis *axis, npy_intp size, npy_intp *dimensions) {
    if (axis->size >= 0 && axis->size != size) return 0;
    if (axis->name < 0) return 1;
    if (dimensions[axis->name] < 0) dimensions[axis->name] = size;
    return dimensions[axis->name] == size;
}

#endif
