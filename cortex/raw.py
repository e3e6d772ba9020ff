"""Publishing bodies that are encoded already: what replaying a recording needs."""

from __future__ import annotations

from typing import NamedTuple, NoReturn

import numpy as np

from cortex.schema import Schema
from cortex.wire import BODY_LIMIT


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
        stamped = any(f.name == "stamp_ns" and str(f.type).startswith(("int", "uint")) for f in schema.fields)
        self.stamp_of = _stamp if stamped else None

    def prepare(self, message: RawMessage, limit: int) -> bytes | RawPlan:
        """The body, or what writes it if it is larger than the limit."""
        size = len(message.body)
        if size > BODY_LIMIT:
            raise ValueError(f"a body has at most {BODY_LIMIT} bytes, got {size}")
        return bytes(message.body) if size <= limit else RawPlan(message.body, size)

    @property
    def drafter(self) -> NoReturn:
        """Refuse: there are no fields to fill."""
        raise TypeError("a raw publisher has nothing to loan")


def _stamp(message: RawMessage) -> int:
    return message.stamp_ns
