"""The codec of a message type: message to body and back (WIRE.md, section 5), built once for each type."""

from __future__ import annotations

import threading
from collections.abc import Callable
from operator import attrgetter
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from cortex.body import Body, MalformedMessage
from cortex.draft import Drafter
from cortex.layout import has_tail
from cortex.native import make_coder
from cortex.schema import MAX_FIXED_BYTES, Schema, schema_of

__all__ = ["Codec", "MalformedMessage", "Plan", "RawCodec", "RawMessage", "codec_of", "coder_of"]


class Plan:
    """A message, ready to be written: its arrays must not change until it is."""

    __slots__ = ("_body", "_message", "size")

    def __init__(self, body: Body, message: Any) -> None:
        self._body = body
        self._message = message
        self.size = body.write(message, None)

    def write(self, buffer: NDArray[np.uint8]) -> int:
        """Write the body to writable memory, arrays with one copy, and return its size [bytes].

        Raises:
            ValueError: The memory is too small.
        """
        if self.size > len(buffer):
            raise ValueError(f"a body of {self.size} bytes does not fit into a buffer of {len(buffer)}")
        return self._body.write(self._message, buffer)

    def to_bytes(self) -> bytes:
        """Return the body."""
        memory = np.empty(self.size, np.uint8)
        self.write(memory)
        return memory.tobytes()


class Codec:
    """Encodes and decodes messages of one type; threads may share it."""

    def __init__(self, message_type: type) -> None:
        self.type = message_type
        self.schema = schema_of(message_type)
        self.fingerprint = self.schema.fingerprint
        self._body = Body(self.schema, message_type)
        block = self._body.block
        is_fixed = not has_tail(self.schema)
        self.fixed_size: int | None = block if is_fixed else None
        """Bytes of every body, if they are always the same."""
        self.stamp_of: Callable[[Any], int] | None = None
        """Gets the stamp of a message, if the type has an integer field `stamp_ns`."""
        if self.schema.stamp_index >= 0:
            self.stamp_of = attrgetter("stamp_ns")
        self._coder = make_coder(self.schema, message_type)
        self.drafter = Drafter(self.schema, message_type, self._body)

    def prepare(self, message: Any, limit: int) -> bytes | Plan:
        """Return the body of a message, or its plan if it would be larger than `limit` bytes.

        Raises:
            TypeError: A value, or an array's dtype, is not of the field's type.
            ValueError: A value is out of range, or an array has the wrong shape.
        """
        if self._coder is not None:
            body: bytes | None = self._coder.encode(message, limit)
            if body is not None:
                return body
        plan = Plan(self._body, message)
        return plan if plan.size > limit else plan.to_bytes()

    def encode(self, message: Any, limit: int) -> bytes:
        """Return the body. It raises as `prepare` does, and ValueError if it would exceed `limit` bytes."""
        body = self.prepare(message, limit)
        if not isinstance(body, bytes):
            raise ValueError(f"{self.schema.name}: a body of {body.size} bytes exceeds the limit of {limit}")
        return body

    def decode(self, buffer: Any, offset: int = 0, size: int | None = None) -> Any:
        """Return the message of a body, which lies in `bytes` or in a read-only array of bytes.

        The message keeps the buffer: its arrays are views of it.

        Raises:
            MalformedMessage: The bytes are no body of the type.
        """
        if self._coder is not None:
            message = self._coder.decode(buffer, offset, len(buffer) - offset if size is None else size)
            if message is not None:
                return message
        return self._body.read(buffer, offset, size)

    def size(self, message: Any) -> int:
        """Return the size of the body [bytes]. It raises as `prepare` does."""
        return self._body.write(message, None)


def coder_of(codec: Any, head: bytes) -> Any:
    """Return what packs and reads the messages of one publisher in C; None: Python does."""
    return make_coder(codec.schema, codec.type, head) if isinstance(codec, Codec) else None


_lock = threading.Lock()


def codec_of(message_type: type) -> Codec:
    """Return the codec of a message type; the same one every time.

    Raises:
        TypeError: It is not a message type.
    """
    try:
        # On the class itself, so that it lives as long: classes come and go with the schemas of others.
        codec: Codec = message_type.__dict__["__cortex_codec__"]
    except (AttributeError, KeyError):
        created = Codec(message_type)
        with _lock:
            if "__cortex_codec__" not in vars(message_type):
                message_type.__cortex_codec__ = created  # type: ignore[attr-defined]
            codec = vars(message_type)["__cortex_codec__"]
    return codec


# Bodies that are encoded already: what replaying a recording needs


class RawMessage(NamedTuple):
    """The body of a message, and its stamp if its type has one."""

    body: bytes | np.ndarray
    stamp_ns: int = 0


class RawPlan(NamedTuple):
    """A large body, ready to be written."""

    body: bytes | np.ndarray
    size: int

    def write(self, buffer: np.ndarray) -> None:
        """Copy the body."""
        np.copyto(buffer[: self.size], np.frombuffer(self.body, np.uint8))


class RawCodec:
    """Stands for a type that is known by its schema only: bodies pass through as they are."""

    type = RawMessage
    fixed_size = None

    def __init__(self, schema: Schema) -> None:
        self.schema = schema
        self.fingerprint = schema.fingerprint
        self.stamp_of = attrgetter("stamp_ns") if schema.stamp_index >= 0 else None

    def prepare(self, message: RawMessage, limit: int) -> bytes | RawPlan:
        """The body, or what writes it if it is larger than the limit."""
        size = len(message.body)
        if size > MAX_FIXED_BYTES:
            raise ValueError(f"a body has at most {MAX_FIXED_BYTES} bytes, got {size}")
        return bytes(message.body) if size <= limit else RawPlan(message.body, size)

    @property
    def drafter(self) -> NoReturn:
        """Refuse: there are no fields to fill."""
        raise TypeError("a raw publisher has nothing to loan")
