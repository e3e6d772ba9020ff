"""The fast path of a message out: `publish` where nothing special is to be done."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import zmq

from cortex.native import NativeFastSend


class FastSend:
    """Sends the messages of one publisher, and counts them: in C. Without C each takes the slow path."""

    prepare: Callable[[int], None]
    """Called with the lock held, and the time, when `refresh_ns` is over."""
    large_acquire: Callable[[bool], bool]
    """Takes the lock of large messages, without waiting if called with False."""
    large_release: Callable[[], None]
    finish: Callable[[Any, int, int, int], bool]
    """Sends what was written into a slot, where something has changed meanwhile; both locks are held.

    The slot, size of the body, its stamp and when it was published [ns]."""

    def __init__(self, slowly: Callable[[Any], bool]) -> None:
        self.sends: tuple[Callable[..., Any], ...] = ()
        """Take a frame and flags; none: every message takes the slow path."""
        self.sequence = 0
        self.bytes = 0
        self.refresh_ns = 0
        """When the next message takes the slow path, on the monotonic clock."""
        self.ring: Any = None
        """The `Broadcast` in C into whose slots larger bodies go; None: they take the slow path."""
        self._slowly = slowly

    def __call__(self, message: Any, /) -> bool:
        """Send a message; False if a reliable subscriber lost it."""
        return self._slowly(message)

    def send_slot(self, message: Any, slot: Any, /) -> bool | None:
        """As a call, of a message that lies in a slot; None: it takes the slow path, unchanged."""
        return None


def make_fast_send(
    coder: Any,
    lock: Any,
    *,
    slowly: Callable[[Any], bool],
    retry: Callable[[bytes, Callable[..., Any]], bool],
    limit: int,
) -> FastSend:
    """Build the fast path of one publisher.

    Args:
        coder: Packs its messages in C, see `coder_of`; None: Python does.
        lock: Held while sending.
        slowly: Called without the lock with a message that takes the slow path.
        retry: Called with the lock held, a frame, and that of `sends` which had no room for it.
        limit: Most bytes of a body that is sent so.
    """
    if coder is None:
        return FastSend(slowly)
    fast_send: FastSend = NativeFastSend(
        coder, lock.acquire, lock.release, lock.locked, slowly, retry, zmq.Again, limit
    )
    fast_send.sends = ()
    return fast_send
