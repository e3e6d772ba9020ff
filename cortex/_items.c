/* Taking from Python what is known of the fields of a message.

   The layout comes from `layout.py`. What memory safety rests on is checked here again: that each item lies within the
   block of what it is part of, and that the numbers of dimensions and names are within bounds. */

#include "_items.h"

#include <stdlib.h>
#include <string.h>

static int take_item(Item *item, Memory **memory, PyObject *row, Py_ssize_t room, int dimension_count);
static int take_message(Block *block, Memory **memory, PyObject *row);

static int refuse(const char *what) {
    PyErr_Format(PyExc_ValueError, "a row of a type: %s", what);
    return 0;
}

/* Room for so many, which lasts as long as the block; NULL with an error set. */
static void *allocate(Memory **memory, Py_ssize_t count, size_t size) {
    Memory *piece = PyMem_Calloc(1, sizeof(Memory) + (size_t)count * size);
    if (piece == NULL) return PyErr_NoMemory();
    piece->before = *memory;
    *memory = piece;
    return piece->content;
}

/* Arrays */

static int take_dtypes(Array *array, Memory **memory, PyObject *dtypes) {
    array->dtypes = allocate(memory, PyTuple_GET_SIZE(dtypes), sizeof(Dtype));
    if (array->dtypes == NULL) return 0;
    for (Py_ssize_t index = 0; index < PyTuple_GET_SIZE(dtypes); ++index) {
        PyObject *descr = PyTuple_GET_ITEM(dtypes, index);
        if (!PyArray_DescrCheck(descr)) return refuse("no dtype");
        PyObject *itemsize = PyObject_GetAttrString(descr, "itemsize");
        if (itemsize == NULL) return 0;
        Dtype *dtype = &array->dtypes[array->dtype_count++];
        dtype->descr = (PyArray_Descr *)descr;
        dtype->itemsize = PyLong_AsSsize_t(itemsize);
        Py_DECREF(itemsize);
        if (dtype->itemsize <= 0) return refuse("items of no size");
    }
    return array->dtype_count > 0 ? 1 : refuse("no dtype");
}

static int take_axes(Array *array, Memory **memory, PyObject *sizes, PyObject *names, int dimension_count) {
    if (PyTuple_GET_SIZE(sizes) != PyTuple_GET_SIZE(names)) return refuse("as many sizes as names");
    if (PyTuple_GET_SIZE(sizes) > RANK_MAX) return refuse("too many dimensions");
    array->rank = (int)PyTuple_GET_SIZE(sizes);
    array->axes = allocate(memory, array->rank, sizeof(Axis));
    if (array->axes == NULL) return 0;
    for (int axis = 0; axis < array->rank; ++axis) {
        array->axes[axis].size = PyLong_AsSsize_t(PyTuple_GET_ITEM(sizes, axis));
        array->axes[axis].name = (int)PyLong_AsLong(PyTuple_GET_ITEM(names, axis));
        if (PyErr_Occurred()) return 0;
        if (array->axes[axis].name >= dimension_count) return refuse("a name beyond its scope");
    }
    return 1;
}

static int take_array(Array *array, Memory **memory, PyObject *detail, int dimension_count) {
    PyObject *dtypes, *sizes, *names;
    unsigned int head;
    if (!PyArg_ParseTuple(detail, "O!O!O!I", &PyTuple_Type, &dtypes, &PyTuple_Type, &sizes, &PyTuple_Type, &names, &head))
        return 0;
    array->head = head;
    return take_dtypes(array, memory, dtypes) && take_axes(array, memory, sizes, names, dimension_count);
}

/* Bytes of an array whose dtype and sizes are all given; -1: they are not, or it does not fit into any body. */
static Py_ssize_t bytes_of(const Array *array) {
    Py_ssize_t bytes = array->dtypes[0].itemsize;
    for (int axis = 0; axis < array->rank; ++axis) {
        const npy_intp size = array->axes[axis].size;
        if (size < 1 || bytes > BODY_LIMIT / size) return -1;
        bytes *= size;
    }
    return array->dtype_count == 1 ? bytes : -1;
}

/* Enums */

static int compare_numbers(const void *left, const void *right) {
    const int32_t a = ((const Member *)left)->number, b = ((const Member *)right)->number;
    return (a > b) - (a < b);
}

static int compare_members(const void *left, const void *right) {
    const uintptr_t a = (uintptr_t)((const Member *)left)->member, b = (uintptr_t)((const Member *)right)->member;
    return (a > b) - (a < b);
}

static int take_members(Members *members, Memory **memory, PyObject *detail) {
    if (!PyTuple_Check(detail)) return refuse("no members");
    const Py_ssize_t count = PyTuple_GET_SIZE(detail);
    members->by_number = allocate(memory, count, sizeof(Member));
    members->by_member = allocate(memory, count, sizeof(Member));
    if (members->by_number == NULL || members->by_member == NULL) return 0;
    for (; members->count < count; ++members->count) {
        Member *member = &members->by_number[members->count];
        int number;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(detail, members->count), "iO", &number, &member->member)) return 0;
        member->number = number;
    }
    memcpy(members->by_member, members->by_number, (size_t)count * sizeof(Member));
    qsort(members->by_number, (size_t)count, sizeof(Member), compare_numbers);
    qsort(members->by_member, (size_t)count, sizeof(Member), compare_members);
    return 1;
}

/* What has others within */

static int take_optional(Item *item, Memory **memory, PyObject *detail, Py_ssize_t room, int dimension_count) {
    item->inner = allocate(memory, 1, sizeof(Item));
    if (item->inner == NULL || !take_item(item->inner, memory, detail, room, dimension_count)) return 0;
    if (item->inner->offset < 1) return refuse("nothing tells whether it is there");
    item->has_tail = item->inner->has_tail;
    item->size = item->inner->offset + item->inner->size;
    return 1;
}

static int take_list(List *list, Memory **memory, PyObject *detail) {
    PyObject *row;
    if (!PyArg_ParseTuple(detail, "Onnin", &row, &list->stride, &list->alignment, &list->dimension_count,
                          &list->values))
        return 0;
    if (list->values < 1) return refuse("elements of no values");
    if (list->stride < 1 || list->alignment < 1 || list->alignment & (list->alignment - 1)) return refuse("a wrong stride");
    if (list->dimension_count < 0 || list->dimension_count > DIMENSIONS_MAX) return refuse("too many names");
    list->item = allocate(memory, 1, sizeof(Item));
    return list->item != NULL && take_item(list->item, memory, row, list->stride, list->dimension_count);
}

static Py_ssize_t size_of_number(char code) {
    switch (code) {
        case 'b': case 'B': return 1;
        case 'h': case 'H': return 2;
        case 'i': case 'I': case 'f': return 4;
        case 'q': case 'Q': case 'd': return 8;
    }
    return -1;
}

/* Take what is particular to a kind; sets the size, which is -1 if there is something wrong. */
static int take_detail(Item *item, Memory **memory, PyObject *detail, Py_ssize_t room, int dimension_count) {
    item->has_tail = item->kind == VARIABLE || item->kind == STR || item->kind == BYTES || item->kind == LIST;
    switch (item->kind) {
        case NUMBER:
            item->size = size_of_number(item->code);
            return 1;
        case BOOL:
            item->size = 1;
            return 1;
        case STR:
        case BYTES:
            item->size = 8;
            return 1;
        case ENUM:
            item->size = 4;
            return take_members(&item->members, memory, detail);
        case FIXED:
            if (!take_array(&item->array, memory, detail, dimension_count)) return 0;
            item->size = bytes_of(&item->array);
            return 1;
        case VARIABLE:
            if (!take_array(&item->array, memory, detail, dimension_count)) return 0;
            item->size = 8 + 4 * item->array.rank;
            return 1;
        case OPTIONAL:
            return take_optional(item, memory, detail, room, dimension_count);
        case LIST:
            item->size = 8;
            return take_list(&item->list, memory, detail);
        case MESSAGE:
            if (!take_message(&item->block, memory, detail)) return 0;
            item->has_tail = (char)item->block.has_tail;
            item->size = item->block.size;
            return 1;
    }
    return refuse("an unknown kind");
}

/* Take a kind, a code, an offset and a detail; it must lie within the first `room` bytes. */
static int take_item(Item *item, Memory **memory, PyObject *row, Py_ssize_t room, int dimension_count) {
    int kind, code;
    PyObject *detail;
    if (!PyArg_ParseTuple(row, "iCnO", &kind, &code, &item->offset, &detail)) return 0;
    if (kind < NUMBER || kind > MESSAGE || code > 127) return refuse("an unknown kind");
    if (item->offset < 0 || item->offset > room) return refuse("an item beyond the block");
    item->kind = (Kind)kind;
    item->code = (char)code;
    if (!take_detail(item, memory, detail, room - item->offset, dimension_count)) return 0;
    return item->size >= 0 && item->size <= room - item->offset ? 1 : refuse("an item beyond the block");
}

/* Messages */

static int take_field(Block *block, Memory **memory, PyObject *row) {
    PyObject *name, *item;
    if (!PyArg_ParseTuple(row, "UO", &name, &item)) return 0;
    Item *field = &block->fields[block->count++];
    field->slot = slot_of(block->cls, name);
    if (field->slot < 0 || !take_item(field, memory, item, block->size, block->dimension_count)) return 0;
    block->has_tail |= field->has_tail;
    return 1;
}

static int take_message(Block *block, Memory **memory, PyObject *row) {
    PyObject *cls, *fields;
    if (!PyArg_ParseTuple(row, "O!niO!", &PyType_Type, &cls, &block->size, &block->dimension_count, &PyTuple_Type, &fields))
        return 0;
    block->cls = (PyTypeObject *)cls;
    if (block->size < 0 || block->size >= BODY_LIMIT) return refuse("a block of that size");
    if (block->dimension_count < 0 || block->dimension_count > DIMENSIONS_MAX) return refuse("too many names");
    block->fields = allocate(memory, PyTuple_GET_SIZE(fields), sizeof(Item));
    if (block->fields == NULL) return 0;
    for (Py_ssize_t index = 0; index < PyTuple_GET_SIZE(fields); ++index) {
        if (!take_field(block, memory, PyTuple_GET_ITEM(fields, index))) return 0;
    }
    return 1;
}

int take_block(Block *block, PyObject *row) {
    block->row = Py_NewRef(row);
    return take_message(block, &block->memory, row);
}

void free_block(Block *block) {
    for (Memory *piece = block->memory, *before; piece != NULL; piece = before) {
        before = piece->before;
        PyMem_Free(piece);
    }
    Py_XDECREF(block->row);
}
