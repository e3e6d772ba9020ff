"""Bodies to messages: closures built once for each type, which check all offsets, counts and codes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any, TypeAlias

import numpy as np

from cortex.encoder import shared_names
from cortex.layout import (
    BODY_LIMIT,
    DTYPE_CODES,
    DTYPES,
    SCALAR_CODES,
    VALUES_MAX,
    array_dtype,
    block_size,
    has_tail,
    leaves,
    measure,
    measure_fields,
    reading_struct,
    stride_of,
    values_of,
)
from cortex.schema import ArrayType, EnumType, FieldType, ListType, OptionalType, Schema
from cortex.structure import new_message


class MalformedMessage(ValueError):
    """Bytes that are no body of the type; the only exception that decoding raises for them."""


DECODE_ERRORS = (ValueError, TypeError, LookupError, ArithmeticError, struct.error)
"""What following wrong bytes may raise; turned into `MalformedMessage` at the edge."""


class Body:
    """The bytes being decoded."""

    __slots__ = ("buffer", "left", "size", "start", "values_left")

    def __init__(self, buffer: Any, start: int, size: int, left: int) -> None:
        self.buffer = buffer
        self.start = start
        """Where the body begins in the buffer."""
        self.size = size
        self.left = left
        """Bytes that items may still take up.

        Items never overlap in a body that an encoder wrote: their sizes add up to less than the body's.
        Without this bound, many offsets to one place would let a small body demand any amount of memory.
        """
        self.values_left = VALUES_MAX
        """Objects that the elements of lists may still become."""

    def claim(self, offset: int, size: int) -> int:
        """Return where an item lies in the buffer."""
        if offset + size > self.size:
            raise MalformedMessage(f"item at {offset} + {size} lies beyond the body of {self.size} bytes")
        self.left -= size
        if self.left < 0:
            raise MalformedMessage(f"the items claim more than the body of {self.size} bytes")
        return self.start + offset

    def claim_values(self, count: int) -> None:
        """Account for the elements of a list."""
        self.values_left -= count
        if self.values_left < 0:
            raise MalformedMessage(f"the lists hold more than {VALUES_MAX} values; large ones must be arrays")


Scope: TypeAlias = "dict[str, int] | None"
Get: TypeAlias = "Callable[[Sequence[Any], int, Body, Scope], Any]"
"""Makes a value from the numbers of a block that begins at a place in the buffer."""


class Decoder:
    """Reads bodies of one type."""

    def __init__(self, schema: Schema, cls: type) -> None:
        self.schema = schema
        self.block = block_size(schema)
        self._end = BODY_LIMIT if has_tail(schema) else self.block + 1
        self._unpack = reading_struct(schema, self.block).unpack_from
        self._get = _get_message(schema, cls, 0, 0)

    def decode(self, buffer: Any, offset: int = 0, size: int | None = None) -> Any:
        """Return the message whose body begins at `offset`; see `Codec.decode`."""
        available = len(buffer) - offset
        if size is None:
            size = available
        elif size > available:
            raise MalformedMessage(f"{self.schema.name}: body of {size} bytes, {available} are there")
        if not self.block <= size < self._end:
            raise MalformedMessage(
                f"{self.schema.name}: body of {size} bytes, allowed are {self.block} to {self._end - 1}"
            )
        try:
            numbers = self._unpack(buffer, offset)
            return self._get(numbers, offset, Body(buffer, offset, size, size - self.block), None)
        except DECODE_ERRORS as error:
            raise MalformedMessage(f"{self.schema.name}: {error}") from error


def make_get(kind: FieldType, bound: Any, shared: frozenset[str], index: int, offset: int) -> Get:
    """Build the closure for one type.

    Args:
        kind: The type.
        bound: Python class of its enum or message, if there is one within.
        shared: Dimension names to be checked against the scope.
        index: Index of its first number among those of the block.
        offset: Offset in the block.
    """
    if isinstance(kind, str):
        if kind in ("str", "bytes"):
            return _get_text(kind, index)
        return _get_bool(index) if kind == "bool" else _get_number(index)
    if isinstance(kind, EnumType):
        return _get_enum(kind, bound, index)
    if isinstance(kind, ArrayType):
        return _get_fixed_array(kind, offset) if kind.is_fixed else _get_array(kind, shared, index)
    if isinstance(kind, OptionalType):
        return _get_optional(kind, bound, shared, index, offset)
    if isinstance(kind, ListType):
        return _get_list(kind, bound, index)
    return _get_message(kind, bound, index, offset)


def _get_number(index: int) -> Get:
    return lambda numbers, at, body, scope: numbers[index]


def _get_bool(index: int) -> Get:
    def get(numbers: Sequence[Any], at: int, body: Body, scope: Scope) -> bool:
        return _truth(numbers[index])

    return get


def _truth(number: int) -> bool:
    if number > 1:
        raise MalformedMessage(f"a bool is {number}, allowed are 0 and 1")
    return number == 1


def _get_enum(kind: EnumType, bound: type[Enum], index: int) -> Get:
    members = {member.value: member for member in bound}

    def get(numbers: Sequence[Any], at: int, body: Body, scope: Scope) -> Enum:
        member = members.get(numbers[index])
        if member is None:
            raise MalformedMessage(f"enum {kind.name} is {numbers[index]}, allowed are {sorted(members)}")
        return member

    return get


def _get_text(kind: str, index: int) -> Get:
    def get_bytes(numbers: Sequence[Any], at: int, body: Body, scope: Scope) -> bytes:
        size = numbers[index + 1]
        start = body.claim(numbers[index], size)
        return bytes(body.buffer[start : start + size])

    def get_str(numbers: Sequence[Any], at: int, body: Body, scope: Scope) -> str:
        size = numbers[index + 1]
        start = body.claim(numbers[index], size)
        return str(body.buffer[start : start + size], "utf-8")

    return get_str if kind == "str" else get_bytes


def _get_fixed_array(kind: ArrayType, offset: int) -> Get:
    dtype, shape = array_dtype(kind), kind.shape

    def get(numbers: Sequence[Any], at: int, body: Body, scope: Scope) -> Any:
        return np.ndarray(shape, dtype, body.buffer, at + offset)  # type: ignore[arg-type]  # integers only

    return get


def _get_array(kind: ArrayType, shared: frozenset[str], index: int) -> Get:
    rank = len(kind.shape)
    fixed_dtype = None if kind.dtype == "any" else array_dtype(kind)
    head = rank << 8 | (0 if fixed_dtype is None else DTYPE_CODES[kind.dtype])
    sizes = [(axis, size) for axis, size in enumerate(kind.shape) if isinstance(size, int)]
    names = [(axis, size) for axis, size in enumerate(kind.shape) if isinstance(size, str) and size in shared]
    first, end = index + 2, index + 2 + rank

    def get(numbers: Sequence[Any], at: int, body: Body, scope: Scope) -> Any:
        code = numbers[index + 1]
        if fixed_dtype is not None:
            if code != head:
                raise MalformedMessage(f"array descriptor {code:#x}, expected {head:#x}")
            dtype = fixed_dtype
        else:
            if code >> 8 != rank or code & 255 >= len(DTYPES):
                raise MalformedMessage(f"array descriptor {code:#x}, expected {head:#x} and a dtype code")
            dtype = DTYPES[code & 255]
        shape = numbers[first:end]
        for axis, size in sizes:
            if shape[axis] != size:
                raise MalformedMessage(f"array dimension {axis} is {shape[axis]}, expected {size}")
        for axis, name in names:
            if scope.setdefault(name, shape[axis]) != shape[axis]:  # type: ignore[union-attr]
                raise MalformedMessage(f"dimension {name} is {shape[axis]} and {scope[name]}")  # type: ignore[index]
        count = 1
        for size in shape:
            count *= size
        return np.ndarray(shape, dtype, body.buffer, body.claim(numbers[index], count * dtype.itemsize))

    return get


def _get_optional(kind: OptionalType, bound: Any, shared: frozenset[str], index: int, offset: int) -> Get:
    get_item = make_get(kind.item, bound, shared, index + 1, offset + measure(kind)[1])

    def get(numbers: Sequence[Any], at: int, body: Body, scope: Scope) -> Any:
        return get_item(numbers, at, body, scope) if _truth(numbers[index]) else None

    return get


def _get_list(kind: ListType, bound: Any, index: int) -> Get:
    item = kind.item
    stride = stride_of(item)
    code = SCALAR_CODES.get(item, "") if isinstance(item, str) else ""
    names = shared_names([item])
    get_item = make_get(item, bound, names, 0, 0)
    unpack = reading_struct(item, stride).unpack_from
    values = values_of(item)

    def get_elements(numbers: Sequence[Any], at: int, body: Body, scope: Scope) -> list[Any]:
        count = numbers[index + 1]
        body.claim_values(count * values)
        start = body.claim(numbers[index], count * stride)
        buffer = body.buffer
        return [
            get_item(unpack(buffer, place), place, body, {} if names else None)
            for place in range(start, start + count * stride, stride)
        ]

    def get_numbers(numbers: Sequence[Any], at: int, body: Body, scope: Scope) -> list[Any]:
        count = numbers[index + 1]
        body.claim_values(count)
        start = body.claim(numbers[index], count * stride)
        result = list(struct.unpack_from(f"<{count}{code}", body.buffer, start))
        return [_truth(number) for number in result] if item == "bool" else result

    return get_numbers if code else get_elements


def _get_message(schema: Schema, cls: type, index: int, offset: int) -> Get:
    shared = shared_names([field.type for field in schema.fields])
    bindings = cls.__cortex_bindings__  # type: ignore[attr-defined]
    steps: list[tuple[int, int, Get | None]] = []
    for field, bound, place in zip(schema.fields, bindings, measure_fields(schema)[0], strict=True):
        end = index + sum(1 for leaf in leaves(field.type) if leaf.code)
        if isinstance(field.type, str) and field.type in SCALAR_CODES and field.type != "bool":
            if steps and steps[-1][2] is None:  # a run of plain numbers is taken at once
                steps[-1] = (steps[-1][0], end, None)
            else:
                steps.append((index, end, None))
        else:
            steps.append((index, end, make_get(field.type, bound, shared, index, offset + place)))
        index = end

    def get(numbers: Sequence[Any], at: int, body: Body, scope: Scope) -> Any:
        scope = {} if shared else None
        values: list[Any] = []
        for first, last, get_field in steps:
            if get_field is None:
                values += numbers[first:last]
            else:
                values.append(get_field(numbers, at, body, scope))
        return new_message(cls, values)

    return get
