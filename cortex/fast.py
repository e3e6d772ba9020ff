"""Short cuts for flat types: numbers, enums, strings and arrays, but no lists, optionals or messages within.

They do what `encoder` and `decoder` do, in a third of the time. Whatever they cannot handle (a tensor, a
wrong value, a malformed body) they leave to those, which also know what to say about it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from itertools import accumulate
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from cortex.decoder import DECODE_ERRORS
from cortex.encoder import CODE_OF_DTYPE, ENCODE_ERRORS, PADS, TRUTH_TO_BYTE
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
Encode: TypeAlias = Callable[[Any, int], "bytes | None"]
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


def only_vector(schema: Schema, cls: type) -> tuple[np.dtype[Any], int] | None:
    """Return dtype and descriptor code of the vector that ends a type of numbers otherwise; else None."""
    if not is_flat(schema):
        return None
    specials, _ = _specials(schema, cls)
    if len(specials) != 1 or specials[0][0] != len(schema.fields) - 1:
        return None
    _, handling, known = specials[0]
    return (known.dtype, known.head) if _is_vector(handling, known) else None


def fixed_arrays(schema: Schema, cls: type) -> list[tuple[int, np.dtype[Any], tuple[int, ...]]] | None:
    """Return index, dtype and shape of the fixed arrays of a type which is otherwise numbers; else None."""
    if not is_flat(schema):
        return None
    specials, _ = _specials(schema, cls)
    if any(handling is not _FIXED for _, handling, _ in specials):
        return None
    return [(index, known[0], known[1]) for index, _, known in specials]


def block_struct(schema: Schema) -> struct.Struct:
    """Return the struct of the block of a flat type."""
    return writing_structs(schema, block_size(schema))[0][0]


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


def make_encode(schema: Schema, cls: type, fallback: Encode) -> Encode | None:
    """Build a still faster encoder for two shapes of type: only numbers, and numbers before one vector.

    Args:
        schema: A flat type.
        cls: Its class.
        fallback: Called for whatever is not as usual.

    Returns:
        The encoder, or None for other shapes.
    """
    specials, _ = _specials(schema, cls)
    if not specials:
        return _encode_numbers(schema, cls, fallback)
    index, handling, known = specials[0]
    if index == len(schema.fields) - 1 and _is_vector(handling, known):
        encode = _encode_vector(schema, cls, fallback, known)
        return _encode_stamped(schema, cls, encode, known) if index == 1 else encode
    return None


def _encode_numbers(schema: Schema, cls: type, fallback: Encode) -> Encode:
    block = block_size(schema)
    pack = writing_structs(schema, block)[0][0].pack
    get_all = getter([field.name for field in schema.fields])

    def encode_numbers(message: Any, limit: int) -> bytes | None:
        try:
            if message.__class__ is cls and block <= limit:
                return pack(*get_all(message))
        except ENCODE_ERRORS:
            pass
        return fallback(message, limit)

    return encode_numbers


def _encode_vector(schema: Schema, cls: type, fallback: Encode, known: _Array) -> Encode:
    block = block_size(schema)
    pack = writing_structs(schema, block)[0][0].pack
    get_all = getter([field.name for field in schema.fields])
    dtype, head = known.dtype, known.head
    itemsize = np.dtype(dtype).itemsize
    large = -(-block // 64) * 64
    pad = PADS[large - block]

    def encode_vector(message: Any, limit: int) -> bytes | None:
        try:
            *numbers, array = get_all(message)
            (count,) = array.shape
            size = count * itemsize
            if array.dtype is dtype and message.__class__ is cls and large + size < BODY_LIMIT:
                if size >= LARGE_ARRAY_BYTES:
                    if large + size > limit:
                        return None
                    return b"".join((pack(*numbers, large, head, count), pad, array))
                if size <= limit - block:
                    data: bytes = array.tobytes()
                    return pack(*numbers, block if size else 0, head, count) + data
        except ENCODE_ERRORS:
            pass
        return fallback(message, limit)

    return encode_vector


def _encode_stamped(schema: Schema, cls: type, fallback: Encode, known: _Array) -> Encode:
    # Most messages are a stamp and an array. Naming the stamp saves a fifth of the time.
    block = block_size(schema)
    pack = writing_structs(schema, block)[0][0].pack
    get_all = getter([field.name for field in schema.fields])
    dtype, head = known.dtype, known.head
    itemsize = np.dtype(dtype).itemsize
    large = -(-block // 64) * 64
    pad = PADS[large - block]

    def encode_stamped(message: Any, limit: int) -> bytes | None:
        try:
            stamp, array = get_all(message)
            (count,) = array.shape
            size = count * itemsize
            if array.dtype is dtype and message.__class__ is cls and large + size < BODY_LIMIT:
                if size >= LARGE_ARRAY_BYTES:
                    if large + size > limit:
                        return None
                    return b"".join((pack(stamp, large, head, count), pad, array))
                if 0 < size <= limit - block:
                    data: bytes = array.tobytes()
                    return pack(stamp, block, head, count) + data
        except ENCODE_ERRORS:
            pass
        return fallback(message, limit)

    return encode_stamped


def _is_vector(handling: int, known: Any) -> bool:
    return handling == _VARIABLE and known.dtype is not None and known.rank == 1 and not known.sizes


# Decoding


def make_decode(schema: Schema, cls: type, fallback: Decode) -> Decode:
    """Build the decoder of a flat type.

    Args:
        schema: The type.
        cls: Its class.
        fallback: Called for whatever is not as it should be.
    """
    specials, _ = _specials(schema, cls)
    if not specials:
        return _decode_numbers(schema, cls, fallback)
    index, handling, known = specials[0]
    if index == len(schema.fields) - 1 and _is_vector(handling, known):
        decode = _decode_vector(schema, cls, fallback, known)
        return _decode_stamped(schema, cls, decode, known) if index == 1 else decode
    return _decode_flat(schema, cls, fallback)


def _decode_numbers(schema: Schema, cls: type, fallback: Decode) -> Decode:
    block = block_size(schema)
    unpack = reading_struct(schema, block).unpack_from
    shell = cls.__cortex_shell__  # type: ignore[attr-defined]

    def decode_numbers(buffer: Any, offset: int = 0, size: int | None = None) -> Any:
        try:
            available = len(buffer) - offset
            if available == block if size is None else size == block <= available:
                message = shell(*unpack(buffer, offset))
                message.__class__ = cls
                return message
        except DECODE_ERRORS:
            pass
        return fallback(buffer, offset, size)

    return decode_numbers


def _decode_vector(schema: Schema, cls: type, fallback: Decode, known: _Array) -> Decode:
    block = block_size(schema)
    unpack = reading_struct(schema, block).unpack_from
    shell = cls.__cortex_shell__  # type: ignore[attr-defined]
    dtype, head = known.dtype, known.head
    itemsize = np.dtype(dtype).itemsize
    ndarray = np.ndarray

    def decode_vector(buffer: Any, offset: int = 0, size: int | None = None) -> Any:
        try:
            end = len(buffer) - offset
            if size is not None and size <= end:
                end = size
            elif size is not None:
                return fallback(buffer, offset, size)
            *numbers, start, code, count = unpack(buffer, offset)
            item = count * itemsize
            if code == head and start + item <= end and block + item <= end < BODY_LIMIT:
                message = shell(*numbers, ndarray((count,), dtype, buffer, offset + start))
                message.__class__ = cls
                return message
        except DECODE_ERRORS:
            pass
        return fallback(buffer, offset, size)

    return decode_vector


def _decode_stamped(schema: Schema, cls: type, fallback: Decode, known: _Array) -> Decode:
    block = block_size(schema)
    unpack = reading_struct(schema, block).unpack_from
    shell = cls.__cortex_shell__  # type: ignore[attr-defined]
    dtype, head = known.dtype, known.head
    itemsize = np.dtype(dtype).itemsize
    ndarray = np.ndarray

    def decode_stamped(buffer: Any, offset: int = 0, size: int | None = None) -> Any:
        try:
            if size is None:
                size = len(buffer) - offset
            stamp, start, code, count = unpack(buffer, offset)
            fits = block <= start and start + count * itemsize <= size <= len(buffer) - offset
            if fits and code == head and size < BODY_LIMIT:
                message = shell(stamp, ndarray(count, dtype, buffer, offset + start))
                message.__class__ = cls
                return message
        except DECODE_ERRORS:
            pass
        return fallback(buffer, offset, size)

    return decode_stamped


def _decode_flat(schema: Schema, cls: type, fallback: Decode) -> Decode:
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
