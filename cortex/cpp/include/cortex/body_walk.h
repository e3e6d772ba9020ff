/* SPDX-License-Identifier: Apache-2.0
   Bodies of messages (WIRE.md, section 5): the walk over the values of a type, for C and C++. How messages of a language hold
   values, say the functions that whoever includes this defines. Bytes that are read may change meanwhile: each number is read once. */

#ifndef CORTEX_BODY_WALK_H
#define CORTEX_BODY_WALK_H

#include "body.h"

/* Put a value where it belongs in a message; 0: it cannot be. */
static inline int cortex_put_number(CortexRead *read, const CortexItem *item, const uint8_t *in, char *place);
static inline int cortex_put_bool(CortexRead *read, int truth, char *place);
static inline int cortex_put_member(CortexRead *read, const CortexItem *member, char *place);
static inline int cortex_put_text(CortexRead *read, const CortexItem *item, const uint8_t *in, uint64_t size, char *place);
static inline int cortex_put_array(CortexRead *read, const CortexItem *item, const CortexArray *array, char *place);
/* Make what has others within; NULL, or 0: it cannot be. Then it has places for them. */
static inline char *cortex_put_optional(CortexRead *read, const CortexItem *item, int present, char *place);
static inline int cortex_put_list(CortexRead *read, const CortexItem *item, uint64_t count, char *place, char **elements, size_t *step);
static inline char *cortex_put_message(CortexRead *read, const CortexItem *item, char *place);

/* Find a value at its place in a message; 0: it is not of its type. */
static inline int cortex_get_scalar(CortexWrite *write, const CortexItem *item, const char *place, uint8_t *out);
static inline int cortex_get_text(CortexWrite *write, const CortexItem *item, const char *place, const void **data, uint64_t *size);
static inline int cortex_get_array(CortexWrite *write, const CortexItem *item, const char *place, CortexArray *array);
static inline const char *cortex_get_optional(CortexWrite *write, const CortexItem *item, const char *place); /* NULL: it is not there */
static inline int cortex_get_list(
    CortexWrite *write, const CortexItem *item, const char *place, uint64_t *count, const char **elements, size_t *step);
static inline const char *cortex_get_message(CortexWrite *write, const CortexItem *item, const char *place);
/* Copy an array to where it begins in the body, if there is one already. */
static inline int cortex_copy_array(CortexWrite *write, const CortexArray *array, const char *place, uint64_t start);

static inline uint32_t cortex_u32(const uint8_t *at) {
    uint32_t number;
    memcpy(&number, at, sizeof number);
    return number;
}

static inline void cortex_begin_scope(int64_t *sizes, int64_t count) {
    for (int64_t name = 0; name < count; ++name) sizes[name] = -1;
}

/* Whether an axis may have so many items; notes it where others must agree. */
static inline int cortex_fits(const CortexItem *axis, int64_t size, int64_t *sizes) {
    if (axis->size >= 0 && axis->size != size) return 0;
    if (axis->scope < 0) return 1;
    if (sizes[axis->scope] < 0) sizes[axis->scope] = size;
    return sizes[axis->scope] == size;
}

/* The member of an enum with a number; NULL if there is none. */
static inline const CortexItem *cortex_member(const CortexItem *items, const CortexItem *item, int64_t number) {
    int64_t low = item->first, high = low + item->count;
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (items[middle].code == number) return &items[middle];
        if (items[middle].code < number) low = middle + 1;
        else high = middle;
    }
    return NULL;
}

/* Reading */

static inline int cortex_read_item(CortexRead *read, const CortexItem *item, uint64_t at, char *place, int64_t *sizes);

static inline int cortex_reject(CortexRead *read, const char *why) {
    read->wrong = why;
    return 0;
}

/* Whether so many items may lie there; then their bytes are taken. None of the numbers has more than 32 bits: nothing wraps. */
static inline int cortex_claim(CortexRead *read, uint64_t start, uint64_t count, uint64_t stride) {
    if (count > read->left / stride) return cortex_reject(read, "a body is too short for its items");
    if (start > read->size || count * stride > read->size - start) return cortex_reject(read, "an item leaves the body");
    read->left -= count * stride;
    return 1;
}

static inline int cortex_read_array(CortexRead *read, const CortexItem *item, uint64_t at, char *place, int64_t *sizes) {
    const CortexItem *axes = read->items + item->first;
    const uint8_t *head = read->data + at;
    CortexArray array;
    if (item->kind == CORTEX_FIXED) {
        for (int64_t axis = 0; axis < item->count; ++axis) array.shape[axis] = axes[axis].size;
        array.dtype = 0;
        array.data = head;
        array.bytes = (uint64_t)item->size;
        return cortex_put_array(read, item, &array, place);
    }
    array.dtype = (uint32_t)(cortex_u32(head + 4) - (uint32_t)item->code);
    if (array.dtype >= item->dtypes) return cortex_reject(read, "an array has another dtype or number of dimensions than its type says");
    uint64_t bytes = (uint64_t)axes[item->count + array.dtype].size; /* as if no dimension were 0 */
    int is_empty = 0;
    for (int64_t axis = 0; axis < item->count; ++axis) {
        const uint32_t size = cortex_u32(head + 8 + 4 * axis);
        if (!cortex_fits(&axes[axis], size, sizes)) return cortex_reject(read, "a dimension has another size by the type, or elsewhere");
        if (size != 0 && bytes > (uint64_t)INT64_MAX / size) return cortex_reject(read, "an array has too many items");
        is_empty |= size == 0;
        bytes *= size != 0 ? size : 1;
        array.shape[axis] = size;
    }
    const uint64_t start = cortex_u32(head);
    array.data = read->data + start;
    array.bytes = is_empty ? 0 : bytes;
    return cortex_claim(read, start, array.bytes, 1) && cortex_put_array(read, item, &array, place);
}

static inline int cortex_read_list(CortexRead *read, const CortexItem *list, uint64_t at, char *place) {
    const CortexItem *item = read->items + list->first;
    const uint64_t start = cortex_u32(read->data + at), count = cortex_u32(read->data + at + 4);
    if (count > read->values_left / (uint64_t)list->values) return cortex_reject(read, "lists hold more values than a body may");
    read->values_left -= count * (uint64_t)list->values;
    char *element;
    size_t step;
    if (!cortex_claim(read, start, count, (uint64_t)list->stride) || !cortex_put_list(read, list, count, place, &element, &step)) return 0;
    int64_t sizes[CORTEX_NAMES];
    for (uint64_t index = 0; index < count; ++index, element += step) {
        cortex_begin_scope(sizes, list->scope);
        if (!cortex_read_item(read, item, start + index * (uint64_t)list->stride, element, sizes)) return 0;
    }
    return 1;
}

static inline int cortex_read_message(CortexRead *read, const CortexItem *item, uint64_t at, char *place) {
    char *message = cortex_put_message(read, item, place);
    if (message == NULL) return 0;
    int64_t sizes[CORTEX_NAMES];
    cortex_begin_scope(sizes, item->scope);
    const CortexItem *field = read->items + item->first, *end = field + item->count;
    for (; field < end; ++field)
        if (!cortex_read_item(read, field, at + (uint64_t)field->offset, message + field->place, sizes)) {
            read->field = field; /* whoever is further out writes it last */
            return 0;
        }
    return 1;
}

/* Read the value whose block is at `at`, which is within a block or an element that was checked as a whole. */
static inline int cortex_read_item(CortexRead *read, const CortexItem *item, uint64_t at, char *place, int64_t *sizes) {
    const uint8_t *in = read->data + at;
    switch ((CortexKind)item->kind) {
        case CORTEX_NUMBER:
            return cortex_put_number(read, item, in, place);
        case CORTEX_BOOL: {
            const uint8_t truth = *in;
            return truth > 1 ? cortex_reject(read, "a bool is neither 0 nor 1") : cortex_put_bool(read, truth, place);
        }
        case CORTEX_ENUM: {
            const CortexItem *member = cortex_member(read->items, item, (int32_t)cortex_u32(in));
            return member == NULL ? cortex_reject(read, "a number is no value of its enum") : cortex_put_member(read, member, place);
        }
        case CORTEX_FIXED:
        case CORTEX_VARIABLE:
            return cortex_read_array(read, item, at, place, sizes);
        case CORTEX_STR:
        case CORTEX_BYTES: {
            const uint64_t start = cortex_u32(in), size = cortex_u32(in + 4);
            return cortex_claim(read, start, size, 1) && cortex_put_text(read, item, read->data + start, size, place);
        }
        case CORTEX_OPTIONAL: {
            const CortexItem *inner = read->items + item->first;
            const uint8_t present = *in;
            if (present > 1) return cortex_reject(read, "an optional is neither there nor not");
            char *within = cortex_put_optional(read, item, present, place);
            return !present || (within != NULL && cortex_read_item(read, inner, at + (uint64_t)inner->offset, within, sizes));
        }
        case CORTEX_LIST:
            return cortex_read_list(read, item, at, place);
        case CORTEX_MESSAGE:
            return cortex_read_message(read, item, at, place);
        default:
            return 0;
    }
}

/* Read a body; 0 if it is refused. What was made until then is the caller's. */
static inline int cortex_read_body(
    CortexRead *read, const CortexItem *items, const void *data, uint64_t size, void *owner, char *place) {
    const uint64_t block = (uint64_t)items->size;
    read->items = items;
    read->data = (const uint8_t *)data;
    read->size = size;
    read->left = size - block;
    read->values_left = CORTEX_VALUES;
    read->wrong = NULL;
    read->field = NULL;
    read->owner = owner;
    if (size < block || size >= CORTEX_BODY_LIMIT || (size > block && !items->has_tail)) return cortex_reject(read, "a body has a wrong size");
    return cortex_read_message(read, items, 0, place);
}

/* Writing */

static inline int cortex_write_item(CortexWrite *write, const CortexItem *item, uint64_t at, const char *place, int64_t *sizes);

static inline int cortex_refuse(CortexWrite *write, const char *why) {
    write->wrong = why;
    return 0;
}

/* Where something is to be written in a block: what lies between it and what was written before is zero. */
static inline uint8_t *cortex_reach(CortexWrite *write, uint64_t at, uint64_t size) {
    if (at > write->filled) memset(write->out + write->filled, 0, (size_t)(at - write->filled));
    write->filled = at + size;
    return write->out + at;
}

/* Make room in the tail; what is empty lies at 0. */
static inline int cortex_take(CortexWrite *write, uint64_t size, uint64_t alignment, uint64_t *start) {
    *start = 0;
    if (size == 0) return 1;
    const uint64_t begin = (write->end + alignment - 1) & ~(alignment - 1);
    if (begin > write->limit || size > write->limit - begin) return cortex_refuse(write, "a message does not fit");
    if (write->out != NULL) memset(write->out + write->end, 0, (size_t)(begin - write->end));
    write->end = begin + size;
    *start = begin;
    return 1;
}

/* Write an offset and a second number, as begin the descriptors of all that lies in the tail. */
static inline void cortex_describe(CortexWrite *write, uint64_t at, uint64_t start, uint64_t second) {
    const uint32_t numbers[2] = {(uint32_t)start, (uint32_t)second};
    memcpy(cortex_reach(write, at, sizeof numbers), numbers, sizeof numbers);
}

static inline int cortex_write_array(CortexWrite *write, const CortexItem *item, uint64_t at, const char *place, int64_t *sizes) {
    const CortexItem *axes = write->items + item->first;
    CortexArray array;
    if (!cortex_get_array(write, item, place, &array)) return 0;
    for (int64_t axis = 0; axis < item->count; ++axis)
        if (array.shape[axis] > UINT32_MAX || !cortex_fits(&axes[axis], array.shape[axis], sizes))
            return cortex_refuse(write, "a dimension has another size by the type, or elsewhere");
    if (item->kind == CORTEX_FIXED) {
        cortex_reach(write, at, array.bytes);
        return cortex_copy_array(write, &array, place, at);
    }
    const uint64_t position = (uint64_t)((uintptr_t)array.data - (uintptr_t)write->out);
    uint64_t start = position;
    if (array.bytes == 0 || position >= write->placed) {
        if (!cortex_take(write, array.bytes, array.bytes >= CORTEX_LARGE_BYTES ? 64 : 8, &start)) return 0;
        if (array.bytes != 0 && !cortex_copy_array(write, &array, place, start)) return 0;
    }
    if (write->out == NULL) return 1;
    cortex_describe(write, at, start, (uint64_t)(item->code + array.dtype));
    for (int64_t axis = 0; axis < item->count; ++axis) {
        const uint32_t size = (uint32_t)array.shape[axis];
        const uint64_t where = at + 8 + 4 * (uint64_t)axis;
        memcpy(cortex_reach(write, where, sizeof size), &size, sizeof size);
    }
    return 1;
}

static inline int cortex_write_text(CortexWrite *write, const CortexItem *item, uint64_t at, const char *place) {
    const void *data;
    uint64_t size, start;
    if (!cortex_get_text(write, item, place, &data, &size) || !cortex_take(write, size, 8, &start)) return 0;
    if (write->out == NULL) return 1;
    cortex_describe(write, at, start, size);
    if (size != 0) memcpy(write->out + start, data, (size_t)size);
    return 1;
}

static inline int cortex_write_list(CortexWrite *write, const CortexItem *list, uint64_t at, const char *place) {
    const CortexItem *item = write->items + list->first;
    const char *element;
    uint64_t count, start;
    size_t step;
    if (!cortex_get_list(write, list, place, &count, &element, &step)) return 0;
    if (count > write->values_left / (uint64_t)list->values) return cortex_refuse(write, "lists hold more values than a body may");
    write->values_left -= count * (uint64_t)list->values;
    if (!cortex_take(write, count * (uint64_t)list->stride, (uint64_t)list->alignment, &start)) return 0;
    if (write->out != NULL) cortex_describe(write, at, start, count);
    else if (!item->has_tail) return 1;
    const uint64_t filled = write->filled;
    write->filled = start;
    int64_t sizes[CORTEX_NAMES];
    for (uint64_t index = 0; index < count; ++index, element += step) {
        cortex_begin_scope(sizes, list->scope);
        if (!cortex_write_item(write, item, start + index * (uint64_t)list->stride, element, sizes)) return 0;
    }
    if (write->out != NULL) cortex_reach(write, start + count * (uint64_t)list->stride, 0);
    write->filled = filled;
    return 1;
}

static inline int cortex_write_message(CortexWrite *write, const CortexItem *item, uint64_t at, const char *place) {
    const char *message = cortex_get_message(write, item, place);
    if (message == NULL) return 0;
    int64_t sizes[CORTEX_NAMES];
    cortex_begin_scope(sizes, item->scope);
    const CortexItem *field = write->items + item->first, *end = field + item->count;
    for (; field < end; ++field)
        if ((write->out != NULL || field->has_tail)
            && !cortex_write_item(write, field, at + (uint64_t)field->offset, message + field->place, sizes)) {
            write->field = field;
            return 0;
        }
    return 1;
}

/* Write the value whose block is at `at`. While it is only measured, what lies in the block as a whole is not looked at. */
static inline int cortex_write_item(CortexWrite *write, const CortexItem *item, uint64_t at, const char *place, int64_t *sizes) {
    switch ((CortexKind)item->kind) {
        case CORTEX_NUMBER:
        case CORTEX_BOOL:
        case CORTEX_ENUM:
            return cortex_get_scalar(write, item, place, cortex_reach(write, at, (uint64_t)item->size));
        case CORTEX_FIXED:
        case CORTEX_VARIABLE:
            return cortex_write_array(write, item, at, place, sizes);
        case CORTEX_STR:
        case CORTEX_BYTES:
            return cortex_write_text(write, item, at, place);
        case CORTEX_OPTIONAL: {
            const CortexItem *inner = write->items + item->first;
            const char *within = cortex_get_optional(write, item, place);
            if (within == NULL) return 1;
            if (write->out != NULL) *cortex_reach(write, at, 1) = 1;
            return cortex_write_item(write, inner, at + (uint64_t)inner->offset, within, sizes);
        }
        case CORTEX_LIST:
            return cortex_write_list(write, item, at, place);
        case CORTEX_MESSAGE:
            return cortex_write_message(write, item, at, place);
        default:
            return 0;
    }
}

/* Write a body, or with `out` NULL measure it: `end` says then where it ends. Its tail begins at `placed`, or after the block; 0 if
   it is refused. */
static inline int cortex_write_body(CortexWrite *write, const CortexItem *items, uint8_t *out, uint64_t placed, uint64_t limit, const char *place) {
    const uint64_t block = (uint64_t)items->size;
    write->items = items;
    write->out = out;
    write->placed = placed;
    write->end = placed > block ? placed : block;
    write->limit = limit < CORTEX_BODY_LIMIT ? limit : CORTEX_BODY_LIMIT - 1;
    write->filled = 0;
    write->values_left = CORTEX_VALUES;
    write->wrong = NULL;
    write->field = NULL;
    if (write->end > write->limit) return cortex_refuse(write, "a message does not fit");
    if (!cortex_write_message(write, items, 0, place)) return 0;
    if (out != NULL) cortex_reach(write, block, 0);
    return 1;
}

#endif
