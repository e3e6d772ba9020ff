"""Header and body of a small message packed and read in one go."""

from __future__ import annotations

import functools
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from cortex.codec import Codec, MalformedMessage
from cortex.native import make_coder
from cortex.outlet import DONTWAIT
from cortex.stats import note_latency
from cortex.wire import HEAD_SIZE, HEADER_SIZE, REST

monotonic_ns = time.monotonic_ns


class Reader(NamedTuple):
    """How a subscriber reads the plain messages of one publisher."""

    read: Callable[[bytes], tuple[int, int, Any] | None]
    """A frame to its sequence, publish_ns and message; None: it is none, or not as it should be."""
    drain: Callable[..., tuple[int, int, bytes | None]]
    """Read what waits in a socket; see `drain` below."""
    gather: Callable[..., tuple[int, bytes, int, bytes | None]] | None
    """Read what waits and join the bodies, for types of fixed size, in C; see `Coder.gather`."""
    coder: Any
    """None in Python. Its `slots` may be a `RingReader`: then frames that name slots of it are read, too."""


def coder_of(codec: Codec, head: bytes) -> Any:
    """Return what packs and reads one publisher's messages in C; None: Python does."""
    return make_coder(codec.schema, codec.type, head) if isinstance(codec, Codec) else None


def make_reader(codec: Codec, head: bytes) -> Reader:
    """Build what reads the plain messages of one publisher.

    Args:
        codec: Of its type.
        head: What these frames begin with: the first 24 bytes of the header.
    """
    coder = coder_of(codec, head)
    if coder is not None:
        gather_fixed = None if codec.fixed_size is None else coder.gather
        return Reader(coder.read, coder.drain, gather_fixed, coder)
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

    return Reader(read, functools.partial(drain, read), None, None)


def drain(
    read: Callable[[bytes], tuple[int, int, Any] | None],
    receive: Callable[[int], bytes],
    again: type[BaseException],
    messages: deque[Any],
    expected: int,
    limit: int,
    latency: list[int],
    clock_offset_ns: int,
    may_wait: bool,
) -> tuple[int, int, bytes | None]:
    """Read plain frames that follow one another, and append their messages.

    Args:
        read: As in `Reader`.
        receive: Called with flags; returns a frame.
        again: What it raises when there is none.
        messages: Where they are appended.
        expected: Sequence of the next message; -1: not known.
        limit: Most messages to read.
        latency: Counts by powers of two of a nanosecond; every eighth message is entered (all cost 10 %).
        clock_offset_ns: What to add to the publisher's clock to read it on ours [ns].
        may_wait: Whether to wait a little for the first: call `receive` without DONTWAIT.

    Returns:
        The sequence expected next, how many were read, and what ended it: None where there were no more or
        the limit was reached, or a frame that was taken from the socket and is something else, or out of
        sequence.
    """
    for count in range(limit):
        try:
            frame = receive(0 if may_wait and not count else DONTWAIT)
        except again:
            return expected, count, None
        found = read(frame)
        if found is None or found[0] != expected:
            return expected, count, frame
        expected += 1
        messages.append(found[2])
        if not count & 7:
            note_latency(latency, monotonic_ns() - found[1] - clock_offset_ns)
    return expected, limit, None
