"""The way of a small message out: `publish` where nothing special is to be done."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import zmq

from cortex.native import NativeGate


class Gate(Protocol):
    """Sends the messages of one publisher, and counts them."""

    sends: tuple[Callable[..., Any], ...]
    """Take a frame and flags; none: every message goes the long way."""
    sequence: int
    """Of the next message."""
    bytes: int
    """Of all bodies so far."""
    refresh_ns: int
    """When the next message goes the long way, on the monotonic clock."""
    ring: Any
    """The `Broadcast` in C into whose slots larger bodies go; None: they go the long way."""
    prepare: Callable[[int], None]
    """Called with the lock held, and the time, when `refresh_ns` is over."""
    large_acquire: Callable[[bool], bool]
    """Takes the lock of large messages, without waiting if called with False."""
    large_release: Callable[[], None]
    """Gives it back."""
    finish: Callable[[Any, int, int, int], bool]
    """Sends what was written into a slot, where something has changed meanwhile; both locks are held.

    The slot, size of the body, its stamp and when it was published [ns]."""

    def __call__(self, message: Any, /) -> bool:
        """Send a message; False if a reliable subscriber lost it."""
        ...

    def send_slot(self, message: Any, slot: Any, /) -> bool | None:
        """Send a message whose large arrays lie in a slot that is being written; the lock is held.

        Returns:
            As `__call__`; None if it has to go the long way: then its arrays are as they were.
        """
        ...


class LongGate:
    """Where a message cannot be sent at once: each goes the long way, whatever `sends` are."""

    def __init__(self, slowly: Callable[[Any], bool]) -> None:
        self.sends: tuple[Callable[..., Any], ...] = ()
        self.sequence = 0
        self.bytes = 0
        self.refresh_ns = 0
        self.ring: Any = None
        self.prepare: Callable[[int], None]
        self.large_acquire: Callable[[bool], bool]
        self.large_release: Callable[[], None]
        self.finish: Callable[[Any, int, int, int], bool]
        self._slowly = slowly

    def __call__(self, message: Any, /) -> bool:
        """Send a message; False if a reliable subscriber lost it."""
        return self._slowly(message)

    def send_slot(self, message: Any, slot: Any, /) -> None:
        """Leave it to the long way."""


def make_gate(
    coder: Any,
    lock: Any,
    *,
    slowly: Callable[[Any], bool],
    retry: Callable[[bytes, Callable[..., Any]], bool],
    limit: int,
) -> Gate:
    """Build the gate of one publisher.

    Args:
        coder: Packs its messages in C, see `packer.coder_of`; None: Python does.
        lock: Held while sending.
        slowly: Called without the lock with a message that has to go the long way.
        retry: Called with the lock held, a frame, and that of `sends` which had no room for it.
        limit: Most bytes of a body that is sent so.
    """
    if coder is None:
        return LongGate(slowly)
    gate: Any = NativeGate(coder, lock.acquire, lock.release, slowly, retry, zmq.Again, limit)
    gate.sends = ()
    return gate  # type: ignore[no-any-return]
