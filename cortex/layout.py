"""Where the fields of a message lie in the fixed block of its body (WIRE.md, section 5.1)."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
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
)

ITEM_ALIGNMENT = 8
LARGE_ARRAY_BYTES = 1024
LARGE_ALIGNMENT = 64
ROOT_ALIGNMENT = 8
BODY_LIMIT = 2**32
"""A body is shorter than this [bytes]."""

VALUES_MAX = 1 << 20
"""Most values that the lists of one body may hold together: each becomes an object of 30 to 100 bytes."""

SCALAR_CODES = {
    "bool": "B",
    "int8": "b",
    "int16": "h",
    "int32": "i",
    "int64": "q",
    "uint8": "B",
    "uint16": "H",
    "uint32": "I",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""Codes of the struct module; a bool is a byte, so that a 2 can be told from a 1."""

DTYPES: tuple[np.dtype[Any], ...] = tuple(
    np.dtype(np.dtype(name).newbyteorder("<").str) for name in DTYPE_NAMES
)
"""NumPy dtypes by their code on the wire."""
DTYPE_CODES = {name: code for code, name in enumerate(DTYPE_NAMES)}


def align(position: int, alignment: int) -> int:
    """Return the next multiple of `alignment` from `position` on."""
    return -(-position // alignment) * alignment


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


@dataclass(frozen=True)
class Leaf:
    """One number, or one fixed array, of a block."""

    offset: int
    code: str
    """Code of the struct module; empty for a fixed array."""
    size: int
    """Bytes."""


def leaves(kind: FieldType, offset: int = 0) -> Iterator[Leaf]:
    """Yield what a type at `offset` of a block consists of, in order."""
    if isinstance(kind, str) and kind in SCALAR_CODES:
        yield Leaf(offset, SCALAR_CODES[kind], SCALAR_SIZES[kind])
    elif isinstance(kind, EnumType):
        yield Leaf(offset, "i", 4)
    elif isinstance(kind, ArrayType) and kind.is_fixed:
        yield Leaf(offset, "", fixed_bytes(kind))
    elif isinstance(kind, OptionalType):
        yield Leaf(offset, "B", 1)
        yield from leaves(kind.item, offset + measure(kind)[1])
    elif isinstance(kind, Schema):
        for field, field_offset in zip(kind.fields, measure_fields(kind)[0], strict=True):
            yield from leaves(field.type, offset + field_offset)
    else:  # str, bytes, list, array of variable size: a descriptor of 32-bit numbers
        for position in range(offset, offset + measure(kind)[0], 4):
            yield Leaf(position, "I", 4)


def reading_struct(kind: FieldType, size: int) -> struct.Struct:
    """Return the struct that unpacks all numbers of a block and skips its fixed arrays."""
    return struct.Struct(_format([leaf for leaf in leaves(kind) if leaf.code], 0, size))


def writing_structs(kind: FieldType, size: int) -> list[tuple[struct.Struct, int]]:
    """Return how to write a block of `size` bytes.

    Returns:
        Structs, each with the number of values that it packs. Between two of them lies one large fixed array,
        as a value of its own; smaller fixed arrays are packed as bytes.
    """
    result = []
    pending: list[Leaf] = []
    start = 0
    for leaf in leaves(kind):
        if not leaf.code and leaf.size >= LARGE_ARRAY_BYTES:
            result.append((struct.Struct(_format(pending, start, leaf.offset)), len(pending)))
            pending, start = [], leaf.offset + leaf.size
        else:
            pending.append(leaf)
    result.append((struct.Struct(_format(pending, start, size)), len(pending)))
    return result


def _format(parts: list[Leaf], start: int, end: int) -> str:
    codes = ["<"]
    position = start
    for leaf in parts:
        if leaf.offset > position:
            codes.append(f"{leaf.offset - position}x")
        codes.append(leaf.code or f"{leaf.size}s")
        position = leaf.offset + leaf.size
    if end > position:
        codes.append(f"{end - position}x")
    return "".join(codes)


def has_tail(kind: FieldType) -> bool:
    """Whether bodies of a type differ in size."""
    if isinstance(kind, str):
        return kind in ("str", "bytes")
    if isinstance(kind, ArrayType):
        return not kind.is_fixed
    if isinstance(kind, OptionalType):
        return has_tail(kind.item)
    if isinstance(kind, Schema):
        return any(has_tail(field.type) for field in kind.fields)
    return isinstance(kind, ListType)


def record_dtype(kind: FieldType, size: int | None = None) -> np.dtype[Any]:
    """Return the NumPy dtype of a type without tail, for bodies as an array of structures.

    An optional becomes a structure of `present` and `value`; an enum is its int32.
    """
    if isinstance(kind, str):
        return DTYPES[DTYPE_CODES[kind]]
    if isinstance(kind, EnumType):
        return np.dtype("<i4")
    if isinstance(kind, ArrayType):
        return np.dtype((array_dtype(kind), kind.shape))
    if isinstance(kind, OptionalType):
        total, alignment = measure(kind)
        names, kinds, offsets = ["present", "value"], [np.dtype("?"), record_dtype(kind.item)], [0, alignment]
    elif isinstance(kind, Schema):
        field_offsets, total, _ = measure_fields(kind)
        names, offsets = [field.name for field in kind.fields], list(field_offsets)
        kinds = [record_dtype(field.type) for field in kind.fields]
    else:
        raise AssertionError("a list has no fixed size")
    return np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": size or total})
