"""The frames of WIRE.md: the 64-byte header, kinds, attaching, control."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

from cortex.codec import MalformedMessage, codec_of

VERSION = 1
HEADER_SIZE = 64
PREFIX_SIZE = 16
"""Bytes of a header that ZeroMQ subscriptions match: magic, kind, version, flags, header length, source."""

MESSAGE, LARGE, SLOT, NEXT, ATTACH, RESUME = b"M", b"L", b"S", b"N", b"A", b"R"
CONTROL, REQUEST, REPLY, ERROR = b"C", b"Q", b"P", b"E"

FLAG_STAMP = 1
LAST = 1
"""In `aux` of a frame of kind `N`: nothing follows, the stream ends here."""
BODY_LIMIT = 1 << 30
CONTROL_LIMIT = 16 << 20

_PREFIX = struct.Struct("<3sBBBHQ")
TAIL = struct.Struct("<QQqqQQ")
"""What follows the prefix: fingerprint, sequence, stamp_ns, publish_ns, body length, aux."""
HEAD_SIZE = PREFIX_SIZE + 8
"""Prefix and fingerprint: constant for the messages of one source."""
REST = struct.Struct("<QqqQQ")
"""What follows the head: sequence, stamp_ns, publish_ns, body length, aux."""
_KEY = struct.Struct("<QQ")
_ANSWER = struct.Struct("<QQQQ")


class Header(NamedTuple):
    """A header's fields; `stamp_ns` is None for a type without one."""

    kind: bytes
    source: int
    fingerprint: int
    sequence: int
    stamp_ns: int | None
    publish_ns: int
    body_size: int
    aux: int


def prefix(kind: bytes, source: int, *, stamped: bool) -> bytes:
    """The first 16 bytes of a header: what a subscription matches."""
    return _PREFIX.pack(b"CTX", kind[0], VERSION, FLAG_STAMP if stamped else 0, HEADER_SIZE, source)


def message_head(kind: bytes, source: int, fingerprint: int, *, stamped: bool) -> bytes:
    """The first 24 bytes of a header: what the messages of one source have in common."""
    return prefix(kind, source, stamped=stamped) + fingerprint.to_bytes(8, "little")


def pack_header(header: Header) -> bytes:
    """The 64 bytes of a header."""
    stamp_ns, *times_and_sizes = header[4:]
    tail = TAIL.pack(header.fingerprint, header.sequence, stamp_ns or 0, *times_and_sizes)
    return prefix(header.kind, header.source, stamped=stamp_ns is not None) + tail


def unpack_header(frame: bytes | memoryview) -> Header:
    """Read a header.

    Raises:
        MalformedMessage: Short frame, wrong magic, version or header length.
    """
    if len(frame) < HEADER_SIZE:
        raise MalformedMessage(f"a frame of {len(frame)} bytes is shorter than a header of {HEADER_SIZE}")
    magic, kind, version, flags, size, source = _PREFIX.unpack_from(frame)
    if magic != b"CTX" or version != VERSION or size != HEADER_SIZE or flags & ~FLAG_STAMP:
        raise MalformedMessage(
            f"not a frame of Cortex {VERSION}: magic {magic!r}, version {version}, flags {flags}, "
            f"header of {size} bytes"
        )
    fingerprint, sequence, stamp_ns, *rest = TAIL.unpack_from(frame, PREFIX_SIZE)
    return Header(bytes((kind,)), source, fingerprint, sequence, stamp_ns if flags else None, *rest)


def control_frame(message: Any, sequence: int = 0, *, source: int = 0, told_ns: int = 0) -> bytes:
    """One control message as a frame of kind `C`; `told_ns` is the time that an `Alive` tells."""
    codec = codec_of(type(message))
    body = codec.encode(message, CONTROL_LIMIT)
    header = Header(CONTROL, source, codec.fingerprint, sequence, None, told_ns, len(body), 0)
    return pack_header(header) + body


def parse_control(frame: bytes, types: Mapping[int, type]) -> tuple[Any, Header]:
    """Decode a control frame.

    Args:
        frame: What a DEALER or ROUTER received.
        types: The message types that are expected here, by fingerprint.

    Raises:
        MalformedMessage: Not a control frame, an unknown type, or a body that does not decode.
    """
    header = unpack_header(frame)
    if header.kind != CONTROL:
        raise MalformedMessage(f"kind {header.kind!r} where {CONTROL!r} was expected")
    check_body(header, len(frame))
    kind = types.get(header.fingerprint)
    if kind is None:
        raise MalformedMessage(f"unexpected control message of type {header.fingerprint:016x}")
    return codec_of(kind).decode(frame, HEADER_SIZE, header.body_size), header


def check_body(header: Header, frame_size: int, limit: int = CONTROL_LIMIT) -> None:
    """A single frame holds exactly its header and its body, and no more than the limit."""
    if header.body_size > limit or frame_size != HEADER_SIZE + header.body_size:
        raise MalformedMessage(
            f"a frame of {frame_size} bytes says that its body has {header.body_size} (limit {limit})"
        )


class AttachKey(NamedTuple):
    """What a reader asks for when it attaches to a publisher."""

    source: int
    reader: int
    shared_memory: bool
    strict: bool
    quota: int
    timeout_ms: int


class AttachAnswer(NamedTuple):
    """A publisher's answer to a reader."""

    sequence: int
    latched: bytes


KEY_SIZE = PREFIX_SIZE + _KEY.size


def attach_key(key: AttachKey, *, stamped: bool) -> bytes:
    """The 32 bytes that a reader subscribes to, and that the answer begins with."""
    options = (
        int(key.shared_memory)
        | int(key.strict) << 1
        | min(key.quota, 255) << 8
        | min(key.timeout_ms, 2**32 - 1) << 32
    )
    return prefix(ATTACH, key.source, stamped=stamped) + _KEY.pack(key.reader, options)


def parse_attach_key(data: bytes) -> AttachKey | None:
    """Read an attach key from a subscription; None if the subscription is something else."""
    if len(data) != KEY_SIZE or data[:4] != b"CTX" + ATTACH:
        return None
    source = int.from_bytes(data[8:16], "little")
    reader, options = _KEY.unpack_from(data, PREFIX_SIZE)
    return AttachKey(
        source, reader, bool(options & 1), bool(options & 2), (options >> 8) & 0xFF, options >> 32
    )


def resume_key(source: int, reader: int, sequence: int, *, stamped: bool) -> bytes:
    """What a reliable reader subscribes to for a moment: it has accounted for all below a sequence."""
    return prefix(RESUME, source, stamped=stamped) + _KEY.pack(reader, sequence)


def parse_resume_key(data: bytes) -> tuple[int, int, int] | None:
    """Source, reader and sequence of a resume key; None if the subscription is something else."""
    if len(data) != KEY_SIZE or data[:4] != b"CTX" + RESUME:
        return None
    return int.from_bytes(data[8:16], "little"), *_KEY.unpack_from(data, PREFIX_SIZE)


def answer_frame(key: bytes, answer: AttachAnswer) -> bytes:
    """The frame that answers a reader; `key` is the 32 bytes that it subscribed to."""
    return key + _ANSWER.pack(answer.sequence, 1, len(answer.latched), 0) + answer.latched


def parse_answer(frame: bytes) -> AttachAnswer:
    """Read an attach answer.

    Raises:
        MalformedMessage: The counts do not match the frame's length.
    """
    start = KEY_SIZE + _ANSWER.size
    if len(frame) < start:
        raise MalformedMessage(f"an attach answer of {len(frame)} bytes is too short")
    sequence, _, latched, _ = _ANSWER.unpack_from(frame, KEY_SIZE)
    if latched > BODY_LIMIT or len(frame) != start + latched:
        raise MalformedMessage(f"an attach answer of {len(frame)} bytes cannot hold {latched} bytes")
    return AttachAnswer(sequence, frame[start:])
