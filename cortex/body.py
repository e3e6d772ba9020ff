"""Bodies of messages, written and read as in WIRE.md, section 5: the reference, and what works without C.

`_coder.c` does the same many times faster, for all that is as usual. What it leaves, such as tensors and
messages with a mistake, comes here, where each error names its field.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Sequence
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cortex import layout
from cortex.schema import SCALAR_CODES, ArrayType, EnumType, FieldType, ListType, OptionalType, Schema
from cortex.structure import is_tensor, new_message
from cortex.tensors import to_numpy

_CODE_OF_DTYPE = {dtype: code for code, dtype in enumerate(layout.DTYPES)}
Sizes = dict[str, int]


class MalformedMessage(ValueError):
    """Bytes that are no body of the type; the only exception that decoding raises for them."""


class Field(NamedTuple):
    """A field of a message."""

    name: str
    type: FieldType
    bound: Any
    """Python class of its enum or message, if there is one within."""
    offset: int
    """In the block of the message."""


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
        if value.dtype not in _CODE_OF_DTYPE:
            raise TypeError(
                f"dtype {value.dtype} is none of {', '.join(layout.DTYPE_CODES)} in native byte order"
            )
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


Fields = dict[type, tuple[Field, ...]]
"""The fields of a message type, and of those within it, by class."""


def _find_fields(kind: FieldType, bound: Any, found: Fields) -> Fields:
    if isinstance(kind, OptionalType | ListType):
        _find_fields(kind.item, bound, found)
    elif isinstance(kind, Schema) and bound not in found:
        offsets = layout.measure_fields(kind)[0]
        rows = zip(kind.fields, bound.__cortex_bindings__, offsets, strict=True)
        found[bound] = tuple(Field(field.name, field.type, inner, at) for field, inner, at in rows)
        for field in found[bound]:
            _find_fields(field.type, field.bound, found)
    return found


class Writer:
    """Writes one message.

    Without memory, which has a block of zeros, it is only measured.
    """

    def __init__(self, fields: Fields, block: int, memory: NDArray[np.uint8] | None) -> None:
        self._fields = fields
        self._memory = memory
        self.end = block
        self._values_left = layout.VALUES_MAX

    def reserve(self, size: int, alignment: int) -> int:
        """Keep room in the tail, and return its offset."""
        start = layout.align(self.end, alignment)
        if self._memory is not None:
            self._memory[self.end : start] = 0
        self.end = start + size
        if self.end >= layout.BODY_LIMIT:
            raise ValueError(f"the body would have {self.end} bytes, it must be shorter than 2^32")
        return start

    def pack(self, code: str, at: int, *numbers: Any) -> None:
        """Put numbers somewhere."""
        if self._memory is not None:
            struct.pack_into("<" + code, self._memory.data, at, *numbers)

    def put_message(self, schema: Schema, cls: type, value: Any, at: int, where: str) -> None:
        """Put a message whose block begins at an offset."""
        if type(value) is not cls:
            raise TypeError(f"{where}: got {type(value).__name__}, expected {cls.__name__}")
        sizes: Sizes = {}
        for field in self._fields[cls]:
            name = f"{where}.{field.name}"
            self.put(field.type, field.bound, getattr(value, field.name), at + field.offset, name, sizes)

    def put(self, kind: FieldType, bound: Any, value: Any, at: int, where: str, sizes: Sizes) -> None:
        """Put a value of any type."""
        if isinstance(kind, OptionalType):
            if value is not None:
                self.pack("B", at, 1)
                self.put(kind.item, bound, value, at + layout.measure(kind)[1], where, sizes)
        elif isinstance(kind, ListType):
            self._put_list(kind, bound, value, at, where)
        elif isinstance(kind, Schema):
            self.put_message(kind, bound, value, at, where)
        elif isinstance(kind, EnumType):
            self.pack("i", at, _number_of(bound, value, where))
        elif isinstance(kind, ArrayType):
            self._put_array(kind, value, at, where, sizes)
        elif kind in ("str", "bytes"):
            data = _bytes_of(kind, value, where)
            start = self.reserve(len(data), 8) if data else 0
            self.pack("II", at, start, len(data))
            if self._memory is not None:
                self._memory[start : start + len(data)] = np.frombuffer(data, np.uint8)
        else:
            self.pack(SCALAR_CODES[kind], at, _checked_number(kind, value, where))

    def _put_list(self, kind: ListType, bound: Any, value: Any, at: int, where: str) -> None:
        if not isinstance(value, (list, tuple)):
            raise TypeError(f"{where}: {value!r:.80} is no list")
        self._values_left -= len(value) * layout.values_of(kind.item)
        if self._values_left < 0:
            raise ValueError(
                f"the lists hold more than {layout.VALUES_MAX} values; send large ones as arrays"
            )
        stride = layout.stride_of(kind.item)
        start = self.reserve(len(value) * stride, max(8, layout.measure(kind.item)[1])) if value else 0
        self.pack("II", at, start, len(value))
        if self._memory is not None:
            self._memory[start : start + len(value) * stride] = 0
        for index, item in enumerate(value):
            self.put(kind.item, bound, item, start + index * stride, f"{where}[{index}]", {})

    def _put_array(self, kind: ArrayType, value: Any, at: int, where: str, sizes: Sizes) -> None:
        try:
            array = as_array(value, None if kind.dtype == "any" else layout.array_dtype(kind))
        except TypeError as error:
            raise TypeError(f"{where}: {error}") from error
        check_shape(kind, array.shape, where, sizes)
        start = at
        if not kind.is_fixed:
            start = self.reserve(array.nbytes, layout.alignment_of(array.nbytes)) if array.size else 0
            self.describe(array.dtype, array.shape, start, at)
        if self._memory is not None and array.size:
            np.copyto(np.ndarray(array.shape, array.dtype, self._memory, start), array)

    def describe(self, dtype: np.dtype[Any], shape: tuple[int, ...], start: int, at: int) -> None:
        """Put where an array lies in the tail, and what it is."""
        self.pack(f"{2 + len(shape)}I", at, start, len(shape) << 8 | _CODE_OF_DTYPE[dtype], *shape)


def _number_of(bound: type[Enum], value: Any, where: str) -> Any:
    if type(value) is bound:
        return value._value_
    allowed = ", ".join(str(member) for member in bound)
    what = f"the {type(value).__name__} {value!r:.80} is no {bound.__name__}"
    raise TypeError(f"{where}: {what}; use {bound.__name__}(value), allowed are {allowed}")


def _bytes_of(kind: str, value: Any, where: str) -> bytes:
    wanted = bytes if kind == "bytes" else str
    if not isinstance(value, wanted):
        raise TypeError(f"{where}: {value!r:.80} is no {wanted.__name__}{' object' * (kind == 'bytes')}")
    try:
        return value if isinstance(value, bytes) else value.encode()
    except UnicodeEncodeError as error:
        raise ValueError(f"{where}: {value!r:.80} cannot be encoded as UTF-8: {error.reason}") from error


def check_shape(kind: ArrayType, shape: tuple[int, ...], where: str, sizes: Sizes) -> None:
    """Compare the shape of an array with its type, and with the named dimensions of earlier fields.

    Raises:
        ValueError: They differ.
    """
    if len(shape) != len(kind.shape) or any(
        isinstance(size, int) and size != actual for size, actual in zip(kind.shape, shape, strict=True)
    ):
        expected = f"[{', '.join(str(size) for size in kind.shape)}]"
        raise ValueError(f"{where}: shape {list(shape)}, expected {expected}")
    for size, actual in zip(kind.shape, shape, strict=True):
        if isinstance(size, str) and sizes.setdefault(size, actual) != actual:
            raise ValueError(
                f"{where}: dimension {size} is {actual}, but {sizes[size]} in an earlier field of the message"
            )


def _checked_number(kind: str, value: Any, where: str) -> Any:
    if kind == "bool":
        try:
            return (False, True).index(value)
        except ValueError as error:  # also an array, which has no truth value
            raise TypeError(f"{where}: {value!r:.80} is no bool") from error
    if not (hasattr(value, "__index__") or (kind.startswith("float") and hasattr(value, "__float__"))):
        raise TypeError(f"{where}: {value!r:.80} is no number for {kind}")
    try:
        struct.pack(f"<{SCALAR_CODES[kind]}", value)
    except (struct.error, OverflowError) as error:
        raise ValueError(f"{where}: {value!r:.80} is out of the range of {kind}") from error
    return value


class Reader:
    """Reads one body, and checks all offsets, counts and codes.

    Items may take up so many bytes as are `left`. They never overlap, so that many offsets to one place
    cannot make a small body demand any amount of memory.
    """

    def __init__(self, fields: Fields, buffer: Any, start: int, size: int, left: int) -> None:
        self._fields = fields
        self._buffer = buffer
        self._start = start
        self._size = size
        self._left = left
        self._values_left = layout.VALUES_MAX

    def _claim(self, offset: int, size: int) -> int:
        if offset + size > self._size:
            raise ValueError(f"item at {offset} + {size} lies beyond the body of {self._size} bytes")
        self._left -= size
        if self._left < 0:
            raise ValueError(f"the items claim more than the body of {self._size} bytes")
        return self._start + offset

    def _unpack(self, code: str, at: int) -> tuple[Any, ...]:
        return struct.unpack_from("<" + code, self._buffer, at)

    def get_message(self, cls: type, at: int) -> Any:
        """Return the message whose block begins somewhere in the buffer."""
        sizes: Sizes = {}
        return new_message(
            cls, [self._get(each.type, each.bound, at + each.offset, sizes) for each in self._fields[cls]]
        )

    def _get(self, kind: FieldType, bound: Any, at: int, sizes: Sizes) -> Any:
        if isinstance(kind, OptionalType):
            present = self._get("bool", None, at, sizes)
            return self._get(kind.item, bound, at + layout.measure(kind)[1], sizes) if present else None
        if isinstance(kind, ListType):
            return self._get_list(kind, bound, at)
        if isinstance(kind, Schema):
            return self.get_message(bound, at)
        if isinstance(kind, ArrayType):
            return self._get_array(kind, at, sizes)
        if isinstance(kind, EnumType):
            number = self._unpack("i", at)[0]
            if number not in bound._value2member_map_:
                allowed = sorted(member.value for member in bound)
                raise ValueError(f"enum {kind.name} is {number}, allowed are {allowed}")
            return bound(number)
        if kind in ("str", "bytes"):
            offset, size = self._unpack("II", at)
            start = self._claim(offset, size)
            data = self._buffer[start : start + size]
            return str(data, "utf-8") if kind == "str" else bytes(data)
        number = self._unpack(SCALAR_CODES[kind], at)[0]
        if kind != "bool":
            return number
        if number > 1:
            raise ValueError(f"a bool is {number}, allowed are 0 and 1")
        return number == 1

    def _get_list(self, kind: ListType, bound: Any, at: int) -> list[Any]:
        offset, count = self._unpack("II", at)
        self._values_left -= count * layout.values_of(kind.item)
        if self._values_left < 0:
            raise ValueError(
                f"the lists hold more than {layout.VALUES_MAX} values; large ones must be arrays"
            )
        stride = layout.stride_of(kind.item)
        start = self._claim(offset, count * stride)
        return [self._get(kind.item, bound, start + index * stride, {}) for index in range(count)]

    def _get_array(self, kind: ArrayType, at: int, sizes: Sizes) -> NDArray[Any]:
        if kind.is_fixed:
            fixed: NDArray[Any] = np.ndarray(kind.shape, layout.array_dtype(kind), self._buffer, at)  # type: ignore[arg-type]
            return fixed
        rank = len(kind.shape)
        offset, code, *extents = self._unpack(f"{2 + rank}I", at)
        allowed = range(len(layout.DTYPES)) if kind.dtype == "any" else (layout.DTYPE_CODES[kind.dtype],)
        if code >> 8 != rank or code & 255 not in allowed:
            raise ValueError(
                f"array descriptor {code:#x}, expected rank {rank} and one of dtypes {[*allowed]}"
            )
        shape, dtype = tuple(extents), layout.DTYPES[code & 255]
        check_shape(kind, shape, "array", sizes)
        bytes_ = dtype.itemsize * math.prod(shape)
        array: NDArray[Any] = np.ndarray(shape, dtype, self._buffer, self._claim(offset, bytes_))
        return array


class Body:
    """Writes and reads bodies of one type."""

    def __init__(self, schema: Schema, cls: type) -> None:
        self._schema = schema
        self._cls = cls
        self.fields = _find_fields(schema, cls, {})
        self.block = layout.block_size(schema)
        self._end = layout.BODY_LIMIT if layout.has_tail(schema) else self.block + 1

    def write(self, message: Any, memory: NDArray[np.uint8] | None) -> int:
        """Write a message to memory that is large enough, if any is given; return the size of its body.

        Raises:
            TypeError: A value is not of its field's type.
            ValueError: A value is out of range, or an array has the wrong shape.
        """
        if memory is not None:
            memory[: self.block] = 0
        writer = Writer(self.fields, self.block, memory)
        writer.put_message(self._schema, self._cls, message, 0, self._schema.name)
        return writer.end

    def read(self, buffer: Any, offset: int = 0, size: int | None = None) -> Any:
        """Return the message whose body begins at `offset`; see `Codec.decode`."""
        available = len(buffer) - offset
        if size is None:
            size = available
        elif size > available:
            raise MalformedMessage(f"{self._schema.name}: body of {size} bytes, {available} are there")
        if not self.block <= size < self._end:
            raise MalformedMessage(
                f"{self._schema.name}: body of {size} bytes, allowed are {self.block} to {self._end - 1}"
            )
        try:
            reader = Reader(self.fields, buffer, offset, size, size - self.block)
            return reader.get_message(self._cls, offset)
        except (ValueError, TypeError, LookupError, ArithmeticError, struct.error) as error:
            raise MalformedMessage(f"{self._schema.name}: {error}") from error
