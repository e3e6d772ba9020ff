"""Header and body of a small message packed and read in one go, for the types that are sent most.

They are types of numbers and arrays of fixed shape, and a stamp with one vector. Of every other type, and of
every value that is not as it should be, the packers return None: the codec does it, and says what is wrong.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cortex.codec import Codec
from cortex.encoder import ENCODE_ERRORS, PADS
from cortex.fast import block_struct, fixed_arrays, getter, only_vector
from cortex.layout import LARGE_ARRAY_BYTES, reading_struct
from cortex.raw import RawMessage
from cortex.wire import HEAD_SIZE, HEADER_SIZE, RECORD, REST

Pack = Callable[[Any, int, int, int], "bytes | None"]
"""Message, sequence, publish_ns and the limit of the body's size to bytes; None: do it the long way."""


class Packers(NamedTuple):
    """How a publisher packs its messages."""

    frame: Pack
    """A whole frame."""
    record: Pack
    """A record of a batch; the sequence is not used."""


def make_packers(codec: Codec, head: bytes) -> Packers:
    """Build the packers of one publisher.

    Args:
        codec: Of its type.
        head: What all frames begin with: the first 24 bytes of the header.
    """
    if codec.type is RawMessage:
        return Packers(_never, _never)
    names = [field.name for field in codec.schema.fields]
    stamp = names.index("stamp_ns") if codec.stamp_of is not None else None
    arrays = fixed_arrays(codec.schema, codec.type)
    if arrays is not None:
        return _pack_numbers(codec, head, stamp, arrays)
    vector = only_vector(codec.schema, codec.type)
    if vector is not None and stamp == 0 and len(names) == 2:
        return _pack_vector(codec, head, *vector)
    return Packers(_never, _never)


def _never(message: Any, sequence: int, publish_ns: int, limit: int) -> None:
    return None


def _joined(front: struct.Struct, body: struct.Struct) -> Callable[..., bytes]:
    # Both are little-endian and without implicit padding, so one follows the other as it stands.
    return struct.Struct(front.format + body.format.removeprefix("<")).pack


def _pack_numbers(
    codec: Codec, head: bytes, stamp: int | None, arrays: list[tuple[int, np.dtype[Any], tuple[int, ...]]]
) -> Packers:
    body = block_struct(codec.schema)
    pack_frame, pack_record = _joined(REST, body), _joined(RECORD, body)
    get = getter([field.name for field in codec.schema.fields])
    cls, size = codec.type, body.size

    def values_of(message: Any) -> Any:
        if message.__class__ is not cls:
            raise TypeError
        if not arrays:
            return get(message)
        values = list(get(message))
        for index, dtype, shape in arrays:
            array = values[index]
            if array.dtype is not dtype or array.shape != shape:
                raise TypeError
            values[index] = array.tobytes()
        return values

    def frame(message: Any, sequence: int, publish_ns: int, limit: int) -> bytes | None:
        if size > limit:
            return None
        try:
            values = values_of(message)
            stamp_ns = 0 if stamp is None else values[stamp]
            return head + pack_frame(sequence, stamp_ns, publish_ns, size, 0, *values)
        except ENCODE_ERRORS:
            return None

    def record(message: Any, sequence: int, publish_ns: int, limit: int) -> bytes | None:
        if size > limit:
            return None
        try:
            values = values_of(message)
            stamp_ns = 0 if stamp is None else values[stamp]
            return pack_record(stamp_ns, publish_ns, size, 0, *values)  # the block's size is a multiple of 8
        except ENCODE_ERRORS:
            return None

    return Packers(frame, record)


def _pack_vector(codec: Codec, head: bytes, dtype: np.dtype[Any], code: int) -> Packers:
    body = block_struct(codec.schema)
    pack_frame, pack_record = _joined(REST, body), _joined(RECORD, body)
    get = getter([field.name for field in codec.schema.fields])
    cls, block, itemsize = codec.type, body.size, dtype.itemsize
    large = -(-block // 64) * 64  # where a vector of 1024 bytes or more begins
    pad = PADS[large - block]

    def frame(message: Any, sequence: int, publish_ns: int, limit: int) -> bytes | None:
        try:
            stamp_ns, array = get(message)
            (count,) = array.shape
            size = count * itemsize
            if array.dtype is dtype and message.__class__ is cls:
                if size >= LARGE_ARRAY_BYTES:
                    size += large
                    if size <= limit:
                        front = pack_frame(
                            sequence, stamp_ns, publish_ns, size, 0, stamp_ns, large, code, count
                        )
                        return b"".join((head, front, pad, array))
                elif 0 < size <= limit - block:
                    size += block
                    front = pack_frame(sequence, stamp_ns, publish_ns, size, 0, stamp_ns, block, code, count)
                    data: bytes = array.tobytes()
                    return head + front + data
        except ENCODE_ERRORS:
            pass
        return None

    def record(message: Any, sequence: int, publish_ns: int, limit: int) -> bytes | None:
        try:
            stamp_ns, array = get(message)
            (count,) = array.shape
            size = count * itemsize
            if array.dtype is dtype and message.__class__ is cls and size:
                start, gap = (large, pad) if size >= LARGE_ARRAY_BYTES else (block, b"")
                size += start
                if size <= limit:
                    front = pack_record(stamp_ns, publish_ns, size, 0, stamp_ns, start, code, count)
                    return b"".join((front, gap, array, PADS[-size % 8]))
        except ENCODE_ERRORS:
            pass
        return None

    return Packers(frame, record)


Read = Callable[[bytes], "tuple[int, int, Any] | None"]
"""A frame to its sequence, publish_ns and message; None: do it the long way."""


def make_reader(codec: Codec) -> Read | None:
    """Build what reads header and body of a plain message at once, for the types that `make_packers` serves.

    The caller has compared the first 24 bytes. Returns None for other types.
    """
    if codec.type is RawMessage:
        return None
    if fixed_arrays(codec.schema, codec.type) == []:
        return _read_numbers(codec)
    vector = only_vector(codec.schema, codec.type)
    if vector is not None and codec.stamp_of is not None and len(codec.schema.fields) == 2:
        return _read_vector(codec, *vector)
    return None


def _unpacker(codec: Codec) -> Callable[[bytes, int], tuple[Any, ...]]:
    body = reading_struct(codec.schema, block_struct(codec.schema).size)
    return struct.Struct(REST.format + body.format.removeprefix("<")).unpack_from


def _read_numbers(codec: Codec) -> Read | None:
    if any(field.type == "bool" or not isinstance(field.type, str) for field in codec.schema.fields):
        return None
    unpack, cls = _unpacker(codec), codec.type
    shell = cls.__cortex_shell__  # type: ignore[attr-defined]
    size = block_struct(codec.schema).size

    def read(frame: bytes) -> tuple[int, int, Any] | None:
        try:
            sequence, _, publish_ns, said, _, *values = unpack(frame, HEAD_SIZE)
        except struct.error:
            return None
        if said != size or len(frame) != HEADER_SIZE + size:
            return None
        message = shell(*values)
        message.__class__ = cls
        return sequence, publish_ns, message

    return read


def _read_vector(codec: Codec, dtype: np.dtype[Any], code: int) -> Read:
    unpack, cls, itemsize = _unpacker(codec), codec.type, dtype.itemsize
    shell = cls.__cortex_shell__  # type: ignore[attr-defined]
    block, ndarray = block_struct(codec.schema).size, np.ndarray

    def read(frame: bytes) -> tuple[int, int, Any] | None:
        try:
            sequence, _, publish_ns, size, _, stamp, start, head, count = unpack(frame, HEAD_SIZE)
        except struct.error:
            return None
        if (
            head != code
            or size != len(frame) - HEADER_SIZE
            or start < block
            or start + count * itemsize > size
        ):
            return None
        message = shell(stamp, ndarray(count, dtype, frame, HEADER_SIZE + start))
        message.__class__ = cls
        return sequence, publish_ns, message

    return read
