/* SPDX-License-Identifier: Apache-2.0
   What a walk over the values of a message knows, see `body_walk.h`: a table of rows says where each lies in a body and in a message. */

#ifndef CORTEX_BODY_H
#define CORTEX_BODY_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum {
    CORTEX_RANK = 32,
    CORTEX_NAMES = 64,         /* named dimensions that must agree, in one scope */
    CORTEX_VALUES = 1 << 20,   /* that the elements of all lists of a body may become */
    CORTEX_LARGE_BYTES = 1024, /* an array of so many is aligned to 64 */
};
static const uint64_t CORTEX_BODY_LIMIT = (uint64_t)1 << 32;

typedef enum {
    CORTEX_NUMBER, CORTEX_BOOL, CORTEX_ENUM, CORTEX_FIXED, CORTEX_VARIABLE, CORTEX_STR, CORTEX_BYTES, CORTEX_OPTIONAL, CORTEX_LIST,
    CORTEX_MESSAGE, CORTEX_DIMENSION, CORTEX_DTYPE, CORTEX_MEMBER
} CortexKind;

/* A row: a value of one type, or something that such a value has. `Row` in `table.py` says what the numbers are. */
typedef struct {
    int64_t kind, code, has_tail, place, offset, size, first, count;
    const void *object;
    int64_t scope, stride, alignment, values, dtypes;
} CortexItem;

/* An array in a message, or where it lies in a body. */
typedef struct {
    int64_t shape[CORTEX_RANK];
    int64_t dtype; /* index among those that it may have */
    const void *data;
    uint64_t bytes;
} CortexArray;

/* A body that is read. */
typedef struct {
    const CortexItem *items;
    const uint8_t *data;
    uint64_t size;
    uint64_t left; /* bytes that items may still take: they may not be larger together than the body that brings them */
    uint64_t values_left;
    const char *wrong; /* what is, once something was refused */
    const CortexItem *field; /* of the outermost message, in which it is; NULL: in none */
    void *owner;       /* of the memory */
} CortexRead;

/* A body that is written. */
typedef struct {
    const CortexItem *items;
    uint8_t *out;    /* NULL: it is only measured */
    uint64_t end;    /* where the next item of the tail may begin */
    uint64_t limit;  /* where the body must end */
    uint64_t placed; /* arrays that lie in `out` below this stay where they are */
    uint64_t filled; /* of the block, or of a list, all below this is written */
    uint64_t values_left;
    const char *wrong;
    const CortexItem *field;
} CortexWrite;

#endif
