"""The codec of a message type: message to body and back (WIRE.md, section 5), built once for each type."""

from __future__ import annotations

import threading
from collections.abc import Callable
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex.body import Body, MalformedMessage
from cortex.draft import Drafter
from cortex.layout import has_tail
from cortex.native import make_coder
from cortex.schema import schema_of

__all__ = ["Codec", "MalformedMessage", "Plan", "codec_of", "coder_of"]


class Plan:
    """A message, ready to be written: its arrays must not change until it is."""

    __slots__ = ("_body", "_message", "size")

    def __init__(self, body: Body, message: Any) -> None:
        self._body = body
        self._message = message
        self.size = body.write(message, None)
        """Bytes of the body."""

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
        for field in self.schema.fields:
            if field.name == "stamp_ns" and isinstance(field.type, str) and "int" in field.type:
                self.stamp_of = attrgetter("stamp_ns")
        self.encode: Callable[[Any, int], bytes | None] = self._encode
        """Message and limit to the body, or None if it would be larger than `limit` bytes.

        Raises:
            TypeError: A value, or an array's dtype, is not of the field's type.
            ValueError: A value is out of range, or an array has the wrong shape.
        """
        self.decode: Callable[..., Any] = self._body.read
        """Buffer, offset = 0 and size = None to the message.

        The buffer is `bytes` or a read-only array of bytes. The message keeps it: arrays are views of it.

        Raises:
            MalformedMessage: The bytes are no body of the type.
        """
        self._coder = make_coder(self.schema, message_type)
        if self._coder is not None:
            self.encode = _encode_natively(self._coder.encode, self._encode)
            self.decode = _decode_natively(self._coder.decode, self.decode)
        self.drafter = Drafter(self.schema, message_type, self._body)
        """Makes messages that are written in place."""

    def prepare(self, message: Any, limit: int) -> bytes | Plan:
        """Return the body of a message, or its plan if it would be larger than `limit` bytes.

        It raises as `encode` does.
        """
        if self._coder is not None:
            body: bytes | None = self._coder.encode(message, limit)
            if body is not None:
                return body
        plan = Plan(self._body, message)
        return plan if plan.size > limit else plan.to_bytes()

    def size(self, message: Any) -> int:
        """Return the size of the body [bytes]. It raises as `encode` does."""
        return self._body.write(message, None)

    def _encode(self, message: Any, limit: int) -> bytes | None:
        plan = Plan(self._body, message)
        return None if plan.size > limit else plan.to_bytes()


def _encode_natively(
    native: Callable[[Any, int], bytes | None], fallback: Callable[[Any, int], bytes | None]
) -> Callable[[Any, int], bytes | None]:
    def encode(message: Any, limit: int) -> bytes | None:
        body = native(message, limit)
        return fallback(message, limit) if body is None else body

    return encode


def _decode_natively(native: Callable[..., Any], fallback: Callable[..., Any]) -> Callable[..., Any]:
    def decode(buffer: Any, offset: int = 0, size: int | None = None) -> Any:
        message = native(buffer, offset, len(buffer) - offset if size is None else size)
        return fallback(buffer, offset, size) if message is None else message

    return decode


def coder_of(codec: Any, head: bytes) -> Any:
    """Return what packs and reads the messages of one publisher in C; None: Python does.

    Args:
        codec: Of its type.
        head: The first 24 bytes of its plain frames.
    """
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
