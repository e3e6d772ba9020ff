"""Header and body of a small message packed and read in one go."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from cortex.codec import Codec, MalformedMessage
from cortex.native import make_flat
from cortex.raw import RawMessage
from cortex.wire import HEAD_SIZE, HEADER_SIZE, REST


class Packers(NamedTuple):
    """How a publisher packs its messages; None: do it the long way, which also says what is wrong."""

    frame: Callable[[Any, int, int, int], bytes | None]
    """Message, sequence, publish_ns and the limit of the body's size [bytes] to a whole frame."""
    record: Callable[[Any, int, int], bytes | None]
    """Message, publish_ns and limit to a record of a batch."""


Read = Callable[[bytes], "tuple[int, int, Any] | None"]
"""A frame to its sequence, publish_ns and message; None: it is no plain message, or not as it should be."""


def make_packers(codec: Codec, head: bytes) -> Packers:
    """Build the packers of one publisher.

    Args:
        codec: Of its type.
        head: What all frames begin with: the first 24 bytes of the header.
    """
    flat = None if codec.type is RawMessage else make_flat(codec.schema, codec.type, head)
    return Packers(_no_frame, _no_record) if flat is None else Packers(flat.frame, flat.record)


def _no_frame(message: Any, sequence: int, publish_ns: int, limit: int) -> None:
    return None


def _no_record(message: Any, publish_ns: int, limit: int) -> None:
    return None


def make_reader(codec: Codec, head: bytes) -> Read:
    """Build what reads the plain messages of one publisher.

    Args:
        codec: Of its type.
        head: What these frames begin with: the first 24 bytes of the header.
    """
    flat = None if codec.type is RawMessage else make_flat(codec.schema, codec.type, head)
    if flat is not None:
        return flat.read  # type: ignore[no-any-return]
    decode, unpack = codec.decode, REST.unpack_from

    def read(frame: bytes) -> tuple[int, int, Any] | None:
        if frame[:HEAD_SIZE] != head or len(frame) < HEADER_SIZE:
            return None
        sequence, _, publish_ns, size, _ = unpack(frame, HEAD_SIZE)
        if size != len(frame) - HEADER_SIZE:
            return None
        try:
            return sequence, publish_ns, decode(frame, HEADER_SIZE, size)
        except MalformedMessage:
            return None

    return read
