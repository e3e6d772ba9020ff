"""Messages to bodies: closures built once for each type, which put numbers into a block, arrays in a tail."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Sequence
from enum import Enum
from operator import attrgetter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cortex.layout import (
    BODY_LIMIT,
    DTYPE_CODES,
    DTYPES,
    LARGE_ARRAY_BYTES,
    SCALAR_CODES,
    VALUES_MAX,
    array_dtype,
    block_size,
    fixed_bytes,
    leaves,
    measure,
    stride_of,
    values_of,
    writing_structs,
)
from cortex.schema import ArrayType, EnumType, FieldType, ListType, OptionalType, Schema
from cortex.structure import is_tensor
from cortex.tensors import to_numpy

Part: TypeAlias = "bytes | NDArray[Any]"
Scope: TypeAlias = "dict[str, int] | None"
Put: TypeAlias = "Callable[[Any, list[Any], Tail, Scope], None]"
"""Appends the numbers of a value to a block, and what does not fit there to the tail."""

ENCODE_ERRORS = (TypeError, ValueError, AttributeError, LookupError, ArithmeticError, struct.error)
"""What a wrong value may raise; `checks.explain` then finds out which it was."""

_SMALL_BYTES = 4096
"""Up to this size an array is copied faster as bytes."""
PADS = [bytes(count) for count in range(64)]
TRUTH_TO_BYTE = {False: 0, True: 1}
CODE_OF_DTYPE = {dtype: code for code, dtype in enumerate(DTYPES)}


class Tail:
    """What follows the fixed block: parts in order, each padded to its place."""

    __slots__ = ("end", "parts", "values_left")

    def __init__(self, end: int) -> None:
        self.end = end
        """Where the next item may begin, counted from the start of the body."""
        self.parts: list[Any] = []
        self.values_left = VALUES_MAX
        """Objects that the elements of lists may still become where they are read."""

    def add(self, part: Any, size: int, mask: int) -> int:
        """Append an item at a multiple of mask + 1 and return its offset."""
        end = self.end
        start = (end + mask) & ~mask
        if start != end:
            self.parts.append(PADS[start - end])
        self.parts.append(part)
        self.end = start + size
        return start

    def add_array(self, array: NDArray[Any]) -> int:
        """Append a non-empty array and return its offset."""
        size = array.nbytes
        return self.add(array, size, 63 if size >= LARGE_ARRAY_BYTES else 7)


class Encoder:
    """Lays out messages of one type as lists of parts."""

    def __init__(self, schema: Schema, cls: type) -> None:
        self.block = block_size(schema)
        self.put_fields = field_puts(schema, cls)
        self._put = _put_message(schema, cls)
        self._pack = pack_block(schema, self.block)

    def layout(self, message: Any) -> tuple[list[Part], int]:
        """Return the parts of the body and its size. It raises `ENCODE_ERRORS`."""
        values: list[Any] = []
        tail = Tail(self.block)
        self._put(message, values, tail, None)
        return self.finish(values, tail), tail.end

    def finish(self, values: list[Any], tail: Tail) -> list[Part]:
        """Return the parts of the body from the numbers of its block and the complete tail."""
        if tail.end >= BODY_LIMIT:
            raise ValueError(f"the body would have {tail.end} bytes, it must be shorter than 2^32")
        return self._pack(values) + tail.parts


def join(parts: list[Any]) -> bytes:
    """Return parts as one body."""
    try:
        return b"".join(parts)
    except TypeError:  # an array is not contiguous
        return b"".join(part if isinstance(part, bytes) else part.tobytes() for part in parts)


def write(parts: list[Any], buffer: NDArray[np.uint8]) -> None:
    """Copy parts into memory, arrays directly; an integer leaves as many bytes as they are."""
    small: list[bytes] = []
    start = position = 0
    view = buffer.data
    for part in parts:
        if isinstance(part, np.ndarray) and part.nbytes <= _SMALL_BYTES:
            part = part.tobytes()
        if isinstance(part, bytes):
            small.append(part)
            position += len(part)
            continue
        if small:
            view[start:position] = b"".join(small)
            small.clear()
        if isinstance(part, int):
            start = position = position + part
            continue
        np.copyto(np.ndarray(part.shape, part.dtype, buffer, position), part)
        position += part.nbytes
        start = position
    if small:
        view[start:position] = b"".join(small)


def as_array(value: Any, dtype: np.dtype[Any] | None) -> NDArray[Any]:
    """Return an array or a CPU tensor as an array of the wanted dtype, without a copy.

    Raises:
        TypeError: It is neither, or its dtype differs.
    """
    if is_tensor(value):
        value = to_numpy(value)
    if not isinstance(value, np.ndarray):
        raise TypeError(f"expected an array, got {type(value).__name__}")
    if dtype is None:
        if value.dtype not in CODE_OF_DTYPE:
            raise TypeError(f"dtype {value.dtype} is none of {', '.join(DTYPE_CODES)} in native byte order")
    elif value.dtype != dtype:
        raise TypeError(f"dtype {value.dtype}, expected {dtype}; convert it, as with .astype(np.{dtype})")
    return value


def shared_names(kinds: Sequence[FieldType]) -> frozenset[str]:
    """Return the dimension names that occur more than once among the fields of a message."""
    counts: Counter[str] = Counter()
    for kind in kinds:
        if isinstance(kind, OptionalType):
            kind = kind.item
        if isinstance(kind, ArrayType):
            counts.update(size for size in kind.shape if isinstance(size, str))
    return frozenset(name for name, count in counts.items() if count > 1)


def pack_block(kind: FieldType, size: int) -> Callable[[list[Any]], list[Part]]:
    """Return a function from the values of a block to its parts."""
    structs = writing_structs(kind, size)
    if len(structs) == 1:
        pack = structs[0][0].pack
        return lambda values: [pack(*values)]

    def pack_segments(values: list[Any]) -> list[Part]:
        parts: list[Part] = []
        position = 0
        for segment, count in structs:
            if position:
                parts.append(values[position - 1])
            if segment.size:
                parts.append(segment.pack(*values[position : position + count]))
            position += count + 1
        return parts

    return pack_segments


def field_puts(schema: Schema, cls: type) -> list[Put]:
    """Return how to put each field of a message."""
    shared = shared_names([field.type for field in schema.fields])
    bindings = cls.__cortex_bindings__  # type: ignore[attr-defined]
    return [make_put(field.type, bound, shared) for field, bound in zip(schema.fields, bindings, strict=True)]


def make_put(kind: FieldType, bound: Any, shared: frozenset[str]) -> Put:
    """Build the closure for one type.

    Args:
        kind: The type.
        bound: Python class of its enum or message, if there is one within.
        shared: Dimension names to be checked against the scope.
    """
    if isinstance(kind, str):
        return {"str": _put_str, "bytes": _put_bytes, "bool": _put_bool}.get(kind, _put_number)
    if isinstance(kind, EnumType):
        return _put_enum(bound)
    if isinstance(kind, ArrayType):
        return _put_fixed_array(kind) if kind.is_fixed else _put_array(kind, shared)
    if isinstance(kind, OptionalType):
        return _put_optional(kind, bound, shared)
    if isinstance(kind, ListType):
        return _put_list(kind, bound)
    return _put_message(kind, bound)


def _put_number(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
    values.append(value)


def _put_bool(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
    values.append(TRUTH_TO_BYTE[value])


def _put_str(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
    if not isinstance(value, str):
        raise TypeError
    _put_bytes(value.encode(), values, tail, scope)


def _put_bytes(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
    if not isinstance(value, bytes):
        raise TypeError
    size = len(value)
    values += (tail.add(value, size, 7), size) if size else (0, 0)


def _put_enum(bound: type[Enum]) -> Put:
    def put(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
        if type(value) is not bound:
            raise TypeError
        values.append(value._value_)

    return put


def _put_fixed_array(kind: ArrayType) -> Put:
    dtype, shape = array_dtype(kind), kind.shape
    is_large = fixed_bytes(kind) >= LARGE_ARRAY_BYTES

    def put(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
        if value.dtype is not dtype:
            value = as_array(value, dtype)
        if value.shape != shape:
            raise ValueError
        if is_large:
            values.append(value)
        else:
            values.append(value.tobytes())

    return put


def _put_array(kind: ArrayType, shared: frozenset[str]) -> Put:
    dtype = None if kind.dtype == "any" else array_dtype(kind)
    rank = len(kind.shape)
    head = rank << 8 | (0 if dtype is None else DTYPE_CODES[kind.dtype])
    sizes = [(axis, size) for axis, size in enumerate(kind.shape) if isinstance(size, int)]
    names = [(axis, size) for axis, size in enumerate(kind.shape) if isinstance(size, str) and size in shared]

    def put(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
        code = head
        if dtype is None:
            value = as_array(value, None)
            code += CODE_OF_DTYPE[value.dtype]
        elif value.dtype is not dtype:
            value = as_array(value, dtype)
        shape = value.shape
        if len(shape) != rank:
            raise ValueError
        for axis, size in sizes:
            if shape[axis] != size:
                raise ValueError
        for axis, name in names:
            if scope.setdefault(name, shape[axis]) != shape[axis]:  # type: ignore[union-attr]
                raise ValueError
        values += (tail.add_array(value) if value.size else 0, code, *shape)

    return put


def _zeros(kind: FieldType) -> list[Any]:
    """Return the values of an absent optional's item."""
    result: list[Any] = []
    for leaf in leaves(kind):
        if leaf.code:
            result.append(0)
        else:  # struct fills up a shorter bytes object with zeros
            result.append(bytes(leaf.size) if leaf.size >= LARGE_ARRAY_BYTES else b"")
    return result


def _put_optional(kind: OptionalType, bound: Any, shared: frozenset[str]) -> Put:
    put_item = make_put(kind.item, bound, shared)
    absent = [0, *_zeros(kind.item)]

    def put(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
        if value is None:
            values += absent
        else:
            values.append(1)
            put_item(value, values, tail, scope)

    return put


def _put_list(kind: ListType, bound: Any) -> Put:
    item = kind.item
    stride = stride_of(item)
    mask = max(8, measure(item)[1]) - 1
    code = SCALAR_CODES.get(item, "") if isinstance(item, str) and item != "bool" else ""
    names = shared_names([item])
    put_item = make_put(item, bound, names)
    pack = pack_block(item, stride)
    weight = values_of(item)

    def put(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
        if not isinstance(value, (list, tuple)):
            raise TypeError
        count = len(value)
        if not count:
            values += (0, 0)
            return
        tail.values_left -= count * weight
        if tail.values_left < 0:
            raise ValueError(f"the lists hold more than {VALUES_MAX} values; send large ones as arrays")
        if code:
            values += (tail.add(struct.pack(f"<{count}{code}", *value), count * stride, mask), count)
            return
        # The elements' block comes first, then what their own tails hold; it is known only after them.
        values += (tail.add(b"", count * stride, mask), count)
        place = len(tail.parts) - 1
        parts: list[Part] = []
        for element in value:
            numbers: list[Any] = []
            put_item(element, numbers, tail, {} if names else None)
            parts += pack(numbers)
        tail.parts[place : place + 1] = parts

    return put


def _put_message(schema: Schema, cls: type) -> Put:
    names = [field.name for field in schema.fields]
    puts = field_puts(schema, cls)
    shared = shared_names([field.type for field in schema.fields])
    steps = _join_numbers(names, puts)

    def put(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
        if type(value) is not cls:
            raise TypeError
        scope = {} if shared else None
        for get, put_field in steps:
            put_field(get(value), values, tail, scope)

    return put


def _join_numbers(names: list[str], puts: list[Put]) -> list[tuple[Callable[[Any], Any], Put]]:
    """Pair each field with its getter; runs of plain numbers are fetched and put at once."""
    steps: list[tuple[Callable[[Any], Any], Put]] = []
    run: list[str] = []
    for name, put in [*zip(names, puts, strict=True), ("", None)]:
        if put is _put_number:
            run.append(name)
            continue
        if len(run) > 1:
            steps.append((attrgetter(*run), _put_numbers))
        elif run:
            steps.append((attrgetter(run[0]), _put_number))
        run = []
        if put is not None:
            steps.append((attrgetter(name), put))
    return steps


def _put_numbers(value: Any, values: list[Any], tail: Tail, scope: Scope) -> None:
    values += value
