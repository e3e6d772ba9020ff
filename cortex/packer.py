"""Header and body of a small message packed in one go, for the types that are sent most."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from cortex.codec import Codec
from cortex.encoder import ENCODE_ERRORS, PADS
from cortex.fast import block_struct, getter, only_vector
from cortex.layout import LARGE_ARRAY_BYTES
from cortex.raw import RawMessage
from cortex.wire import REST

Pack = Callable[[Any, int, int, int], "bytes | None"]
"""Message, sequence, publish_ns and the limit of the body's size to a frame; None: do it the long way."""


def make_packer(codec: Codec, head: bytes) -> Pack:
    """Build the packer of one publisher.

    Args:
        codec: Of its type.
        head: What all frames begin with: the first 24 bytes of the header.
    """
    if codec.type is RawMessage:
        return _never
    names = [field.name for field in codec.schema.fields]
    body = block_struct(codec.schema, codec.type)
    if body is None:
        return _never
    # Both are little-endian and without implicit padding, so one follows the other as it stands.
    pack = struct.Struct(REST.format + body.format.removeprefix("<")).pack
    stamp = names.index("stamp_ns") if codec.stamp_of is not None else None
    if codec.fixed_size is not None:
        return _numbers(codec, head, pack, stamp)
    vector = only_vector(codec.schema, codec.type)
    if vector is None or names[:-1] != ["stamp_ns"] or stamp is None:
        return _never
    return _stamped_vector(codec, head, pack, body.size, *vector)


def _never(message: Any, sequence: int, publish_ns: int, limit: int) -> None:
    return None


def _numbers(codec: Codec, head: bytes, pack: Callable[..., bytes], stamp: int | None) -> Pack:
    get = getter([field.name for field in codec.schema.fields])
    cls, size = codec.type, codec.fixed_size
    assert size is not None

    def pack_numbers(message: Any, sequence: int, publish_ns: int, limit: int) -> bytes | None:
        try:
            if message.__class__ is cls and size <= limit:
                values = get(message)
                stamp_ns = 0 if stamp is None else values[stamp]
                return head + pack(sequence, stamp_ns, publish_ns, size, 0, *values)
        except ENCODE_ERRORS:
            pass
        return None

    return pack_numbers


def _stamped_vector(
    codec: Codec, head: bytes, pack: Callable[..., bytes], block: int, dtype: np.dtype[Any], code: int
) -> Pack:
    get = getter([field.name for field in codec.schema.fields])
    cls, itemsize = codec.type, dtype.itemsize
    large = -(-block // 64) * 64  # where a vector of 1024 bytes or more begins
    pad = PADS[large - block]

    def pack_stamped_vector(message: Any, sequence: int, publish_ns: int, limit: int) -> bytes | None:
        try:
            stamp_ns, array = get(message)
            (count,) = array.shape
            size = count * itemsize
            if array.dtype is dtype and message.__class__ is cls:
                if size >= LARGE_ARRAY_BYTES:
                    size += large
                    if size <= limit:
                        front = pack(sequence, stamp_ns, publish_ns, size, 0, stamp_ns, large, code, count)
                        return b"".join((head, front, pad, array))
                elif 0 < size <= limit - block:
                    data: bytes = array.tobytes()
                    return (
                        head
                        + pack(sequence, stamp_ns, publish_ns, block + size, 0, stamp_ns, block, code, count)
                        + data
                    )
        except ENCODE_ERRORS:
            pass
        return None

    return pack_stamped_vector
