"""Short cuts for flat types: numbers, enums, strings and arrays, but no lists, optionals or messages within.

They do what `encoder` and `decoder` do, in a third of the time. Whatever they cannot handle (a tensor, a
wrong value, a malformed body) they leave to those, which also know what to say about it.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from cortex.decoder import DECODE_ERRORS
from cortex.encoder import CODE_OF_DTYPE, PADS, TRUTH_TO_BYTE
from cortex.layout import (
    BODY_LIMIT,
    DTYPE_CODES,
    DTYPES,
    LARGE_ARRAY_BYTES,
    array_dtype,
    block_size,
    fixed_bytes,
    has_tail,
    leaves,
    measure_fields,
    reading_struct,
    writing_structs,
)
from cortex.schema import ArrayType, EnumType, FieldType, Schema

Layout: TypeAlias = Callable[[Any], "tuple[list[Any], int]"]
"""A message to the parts of its body and the size of it."""
Decode: TypeAlias = Callable[..., Any]
"""Buffer, offset = 0 and size = None to a message."""

_BYTE_TO_TRUTH = {0: False, 1: True}


class _Array(NamedTuple):
    """What is known of an array in advance."""

    dtype: np.dtype[Any] | None
    """None: open."""
    head: int
    """The second number of its descriptor, less an open dtype."""
    rank: int
    sizes: tuple[tuple[int, int], ...]
    """Axis and size where the size is given."""
    names: tuple[tuple[int, int], ...]
    """Axis and number of the name, where the name occurs more than once in the type."""


def describe_arrays(kinds: list[FieldType]) -> tuple[list[_Array | None], int]:
    """Return what is known of each type that is a variable array, and how many names are shared."""
    arrays = [kind for kind in kinds if isinstance(kind, ArrayType) and not kind.is_fixed]
    named = [size for kind in arrays for size in kind.shape if isinstance(size, str)]
    shared = sorted({name for name in named if named.count(name) > 1})
    known: list[_Array | None] = []
    for kind in kinds:
        if not isinstance(kind, ArrayType) or kind.is_fixed:
            known.append(None)
            continue
        dtype = None if kind.dtype == "any" else array_dtype(kind)
        rank = len(kind.shape)
        sizes = tuple((axis, size) for axis, size in enumerate(kind.shape) if isinstance(size, int))
        names = tuple((axis, shared.index(size)) for axis, size in enumerate(kind.shape) if size in shared)
        code = 0 if dtype is None else DTYPE_CODES[kind.dtype]
        known.append(_Array(dtype, rank << 8 | code, rank, sizes, names))
    return known, len(shared)


def is_flat(schema: Schema) -> bool:
    """Whether the short cuts serve a type."""
    for field in schema.fields:
        kind = field.type
        if isinstance(kind, ArrayType):
            if kind.is_fixed and fixed_bytes(kind) >= LARGE_ARRAY_BYTES:
                return False
        elif not isinstance(kind, (str, EnumType)):
            return False
    return bool(schema.fields)


# How a field that is no plain number is handled.
_VARIABLE, _FIXED, _STR, _BYTES, _BOOL, _ENUM = range(6)


def _special(kind: FieldType, bound: Any, known: _Array | None, offset: int) -> tuple[int, Any] | None:
    if known is not None:
        return _VARIABLE, known
    if isinstance(kind, ArrayType):
        return _FIXED, (array_dtype(kind), kind.shape, offset)
    if isinstance(kind, EnumType):
        return _ENUM, bound
    return {"str": (_STR, None), "bytes": (_BYTES, None), "bool": (_BOOL, None)}.get(kind)  # type: ignore[arg-type]


def _specials(schema: Schema, cls: type) -> tuple[list[tuple[int, int, Any]], int]:
    """Return index of the field, handling and what it needs, and the number of shared dimension names."""
    kinds = [field.type for field in schema.fields]
    known, name_count = describe_arrays(kinds)
    bindings = cls.__cortex_bindings__  # type: ignore[attr-defined]
    result = []
    for index, row in enumerate(zip(kinds, bindings, known, measure_fields(schema)[0], strict=True)):
        special = _special(*row)
        if special is not None:
            result.append((index, *special))
    return result, name_count


def getter(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Return a function from a message to the tuple of its fields."""
    if len(names) > 1:
        return attrgetter(*names)
    get = attrgetter(names[0])
    return lambda message: (get(message),)


# Encoding


def make_layout(schema: Schema, cls: type) -> Layout:
    """Build the function that lays out messages of a flat type. It raises `ENCODE_ERRORS`."""
    specials, name_count = _specials(schema, cls)
    block = block_size(schema)
    pack = writing_structs(schema, block)[0][0].pack
    get_all = getter([field.name for field in schema.fields])

    def layout(message: Any) -> tuple[list[Any], int]:
        if message.__class__ is not cls:
            raise TypeError
        fields = get_all(message)
        values: list[Any] = []
        parts: list[Any] = [None]
        end = block
        dims = [-1] * name_count
        last = 0
        for index, handling, known in specials:
            if index != last:
                values += fields[last:index]
            last = index + 1
            value = fields[index]
            if handling is _VARIABLE:
                dtype, head, rank, sizes, names = known
                shape = value.shape
                size = value.nbytes
                if dtype is None:
                    head += CODE_OF_DTYPE[value.dtype]
                elif value.dtype is not dtype:
                    raise TypeError
                if len(shape) != rank:
                    raise ValueError
                for axis, length in sizes:
                    if shape[axis] != length:
                        raise ValueError
                for axis, name in names:
                    if dims[name] != shape[axis]:
                        if dims[name] >= 0:
                            raise ValueError
                        dims[name] = shape[axis]
                start = (end + 63) & -64 if size >= LARGE_ARRAY_BYTES else (end + 7) & -8
                values += (start if size else 0, head, *shape)
            elif handling is _FIXED:
                if value.dtype is not known[0] or value.shape != known[1]:
                    raise ValueError
                values.append(value.tobytes())
                continue
            elif handling is _BOOL:
                values.append(TRUTH_TO_BYTE[value])
                continue
            elif handling is _ENUM:
                if value.__class__ is not known:
                    raise TypeError
                values.append(value._value_)
                continue
            else:
                if handling is _STR:
                    value = str.encode(value)
                elif value.__class__ is not bytes:
                    raise TypeError
                size = len(value)
                start = (end + 7) & -8
                values += (start if size else 0, size)
            if size:
                if start != end:
                    parts.append(PADS[start - end])
                parts.append(value)
                end = start + size
        values += fields[last:]
        if end >= BODY_LIMIT:
            raise ValueError
        parts[0] = pack(*values)
        return parts, end

    return layout


# Decoding


def make_decode(schema: Schema, cls: type, fallback: Decode) -> Decode:
    """Build the decoder of a flat type.

    Args:
        schema: The type.
        cls: Its class.
        fallback: Called for whatever is not as it should be.
    """
    specials, name_count = _specials(schema, cls)
    block = block_size(schema)
    unpack = reading_struct(schema, block).unpack_from
    limit = BODY_LIMIT if has_tail(schema) else block + 1
    widths = [sum(1 for leaf in leaves(field.type) if leaf.code) for field in schema.fields]
    starts = [0, *accumulate(widths)]
    steps = [(starts[index], starts[index + 1], handling, known) for index, handling, known in specials]
    steps = [
        (*row[:3], {member.value: member for member in row[3]} if row[2] == _ENUM else row[3])
        for row in steps
    ]
    shell = cls.__cortex_shell__  # type: ignore[attr-defined]
    ndarray = np.ndarray

    def read(buffer: Any, offset: int, size: int) -> Any:
        numbers = unpack(buffer, offset)
        fields: list[Any] = []
        left = size - block
        dims = [-1] * name_count
        last = 0
        for first, end, handling, known in steps:
            if first != last:
                fields += numbers[last:first]
            last = end
            if handling is _VARIABLE:
                dtype, head, _, sizes, names = known
                start, code, *shape = numbers[first:end]
                if dtype is None:
                    if code < head:
                        raise ValueError
                    dtype = DTYPES[code - head]  # a wrong rank makes it too large an index
                elif code != head:
                    raise ValueError
                for axis, length in sizes:
                    if shape[axis] != length:
                        raise ValueError
                for axis, name in names:
                    if dims[name] != shape[axis]:
                        if dims[name] >= 0:
                            raise ValueError
                        dims[name] = shape[axis]
                item = dtype.itemsize
                for length in shape:
                    item *= length
                left -= item
                if start + item > size:
                    raise ValueError
                fields.append(ndarray(shape, dtype, buffer, offset + start))
            elif handling is _FIXED:
                fields.append(ndarray(known[1], known[0], buffer, offset + known[2]))
            elif handling is _BOOL:
                fields.append(_BYTE_TO_TRUTH[numbers[first]])
            elif handling is _ENUM:
                fields.append(known[numbers[first]])
            else:
                start, item = numbers[first:end]
                left -= item
                if start + item > size:
                    raise ValueError
                data = buffer[offset + start : offset + start + item]
                fields.append(str(data, "utf-8") if handling is _STR else bytes(data))
            if left < 0:
                raise ValueError
        fields += numbers[last:]
        message = shell(*fields)
        message.__class__ = cls
        return message

    def decode_flat(buffer: Any, offset: int = 0, size: int | None = None) -> Any:
        try:
            available = len(buffer) - offset
            end = available if size is None else size
            if block <= end <= available and end < limit:
                return read(buffer, offset, end)
        except DECODE_ERRORS:
            pass
        return fallback(buffer, offset, size)

    return decode_flat
