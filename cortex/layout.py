"""The offsets of the fields of a message in the fixed block of its body (WIRE.md, section 5.1)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cortex.schema import (
    DTYPE_NAMES,
    SCALAR_SIZES,
    ArrayType,
    EnumType,
    FieldType,
    ListType,
    OptionalType,
    Schema,
    nested,
)

ITEM_ALIGNMENT = 8
LARGE_ARRAY_BYTES = 1024
LARGE_ALIGNMENT = 64
ROOT_ALIGNMENT = 8
BODY_LIMIT = 2**32
"""A body is shorter than this [bytes]."""

VALUES_MAX = 1 << 20
"""Most values that the lists of one body may hold together: each becomes an object of 30 to 100 bytes."""

DTYPES: tuple[np.dtype[Any], ...] = tuple(
    np.dtype(np.dtype(name).newbyteorder("<").str) for name in DTYPE_NAMES
)
"""NumPy dtypes by their code on the wire."""
DTYPE_CODES = {name: code for code, name in enumerate(DTYPE_NAMES)}


def align(position: int, alignment: int) -> int:
    """Return the next multiple of `alignment` from `position` on."""
    return -(-position // alignment) * alignment


def alignment_of(size: int) -> int:
    """Return how an array of so many bytes is aligned in the tail."""
    return LARGE_ALIGNMENT if size >= LARGE_ARRAY_BYTES else ITEM_ALIGNMENT


def array_dtype(kind: ArrayType) -> np.dtype[Any]:
    """Return the dtype of an array type that does not leave it open."""
    return DTYPES[DTYPE_CODES[kind.dtype]]


def fixed_bytes(kind: ArrayType) -> int:
    """Return the size of a fixed array [bytes]."""
    return math.prod(int(size) for size in kind.shape) * array_dtype(kind).itemsize


def measure(kind: FieldType) -> tuple[int, int]:
    """Return size [bytes] and alignment of a type in the fixed block."""
    if isinstance(kind, str):
        if kind in ("str", "bytes"):
            return 8, 4
        return SCALAR_SIZES[kind], SCALAR_SIZES[kind]
    if isinstance(kind, EnumType):
        return 4, 4
    if isinstance(kind, ListType):
        return 8, 4
    if isinstance(kind, ArrayType):
        if not kind.is_fixed:
            return 8 + 4 * len(kind.shape), 4
        size = fixed_bytes(kind)
        return size, LARGE_ALIGNMENT if size >= LARGE_ARRAY_BYTES else array_dtype(kind).itemsize
    if isinstance(kind, OptionalType):
        size, alignment = measure(kind.item)
        return align(alignment + size, alignment), alignment
    return measure_fields(kind)[1:]


def measure_fields(schema: Schema) -> tuple[tuple[int, ...], int, int]:
    """Return the offset of each field, and size and alignment of the block of a nested message."""
    offsets = []
    position, largest = 0, 1
    for field in schema.fields:
        size, alignment = measure(field.type)
        position = align(position, alignment)
        offsets.append(position)
        position += size
        largest = max(largest, alignment)
    size = align(position, largest)
    return tuple(offsets), size, largest


def block_size(schema: Schema) -> int:
    """Return the size of the block of an outermost message [bytes]."""
    return align(measure_fields(schema)[1], ROOT_ALIGNMENT)


def stride_of(kind: FieldType) -> int:
    """Return the distance of list elements [bytes]."""
    size, alignment = measure(kind)
    return max(1, align(size, alignment))


def values_of(kind: FieldType) -> int:
    """Return how many objects a value of a type becomes, without the elements of lists within."""
    if isinstance(kind, OptionalType):
        return values_of(kind.item)
    if isinstance(kind, Schema):
        return 1 + sum(values_of(field.type) for field in kind.fields)
    return 1


def has_tail(kind: FieldType) -> bool:
    """Whether bodies of a type differ in size."""
    return any(
        isinstance(each, ListType)
        or each in ("str", "bytes")
        or (isinstance(each, ArrayType) and not each.is_fixed)
        for each in nested(kind)
    )
