"""The way of a message in: `recv` and `async for` where nothing special is to be done.

That is: there is one publisher, nothing waits in the queue, and the next frame is the message that follows.
All else goes the long way, `Subscriber._receive`.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any, Protocol, TypeVar

import zmq

from cortex.link import Item, Link
from cortex.native import NativeArrivals, NativeInlet
from cortex.outlet import DONTWAIT
from cortex.stats import SubscriberCounters, note_latency
from cortex.turn import Turn

T = TypeVar("T")
monotonic_ns = time.monotonic_ns

PAUSE_NS = 1_000_000
PAUSE_COUNT = 1024
"""An asyncio loop that always finds a message runs other tasks after so long, or so many messages."""


class _Nothing:
    """Stands for a message that did not come, or could not be read."""


NOTHING: Any = _Nothing()


class Inlet(Protocol):
    """Takes the messages of one subscriber, and counts them."""

    exhausted: bool
    """Whether the last look into the sockets found nothing."""
    left: int
    """Messages that `soon` may still take."""
    until_ns: int
    """How long it may do so, on the monotonic clock."""

    @property
    def is_open(self) -> bool:
        """Whether there is a link to read."""
        ...

    @property
    def taken_ns(self) -> int:
        """When the last message was taken, on the monotonic clock."""
        ...

    def open(self, link: Link | None, coder: Any, /) -> None:
        """Read a link from now on; None: every message goes the long way. The lock is held."""
        ...

    def __call__(self, may_wait: bool, /) -> Any:
        """Take the next message, after waiting a little for it if that is allowed; `NOTHING` if none came.

        Also if it went to the queue, because it takes more care.
        """
        ...

    def soon(self) -> Any:
        """As a call with False, while an asyncio task may go on: `left` and `until_ns` say so."""
        ...


class PyInlet:
    """As `Inlet`; see `make_inlet`."""

    def __init__(
        self,
        turn: Turn,
        queue: deque[Item],
        counters: SubscriberCounters,
        accept: Callable[[Link, bytes], None],
    ) -> None:
        self.exhausted = True
        self.left = 0
        self.until_ns = 0
        self.taken_ns = 0
        self._turn = turn
        self._queue = queue
        self._counters = counters
        self._accept = accept
        self._link: Link | None = None

    def open(self, link: Link | None, coder: Any, /) -> None:
        """Read a link from now on; None: every message goes the long way. The lock is held."""
        self._link = link

    @property
    def is_open(self) -> bool:
        """Whether there is a link to read."""
        return self._link is not None

    def __call__(self, may_wait: bool, /) -> Any:
        """Take the next message; `NOTHING` if none came, or if it went to the queue."""
        if self._link is None:
            return NOTHING
        with self._turn.lock:
            link = self._link
            if link is None or self._queue or (may_wait and self._turn.waiting):
                return NOTHING
            self.exhausted = True
            try:
                frame = link.receive(0 if may_wait else DONTWAIT)
            except zmq.Again:
                return NOTHING
            self.exhausted = False
            found = link.read(frame)
            if found is None or found[0] != link.expected:
                self._accept(link, frame)
                return NOTHING
            link.expected += 1
            self._counters.received += 1
            self.taken_ns = monotonic_ns()
            note_latency(self._counters.latency, self.taken_ns - found[1] - link.clock_offset_ns)
            return found[2]

    def soon(self) -> Any:
        """As a call with False, while an asyncio task may go on."""
        if self.left <= 0 or monotonic_ns() >= self.until_ns:
            return NOTHING
        self.left -= 1
        return self(False)


def make_inlet(
    turn: Turn, queue: deque[Item], counters: SubscriberCounters, accept: Callable[[Link, bytes], None]
) -> Inlet:
    """Build the inlet of one subscriber.

    Args:
        turn: Its lock.
        queue: What has to be taken before.
        counters: Their `received` and `latency` are kept.
        accept: Called with the lock held, a link, and a frame that does not simply follow.
    """
    if NativeInlet is None:
        return PyInlet(turn, queue, counters, accept)
    inlet: Inlet = NativeInlet(turn.lock, turn, queue, counters, zmq.Again, accept, NOTHING)
    return inlet


def make_arrivals(inlet: Inlet, slowly: Callable[[], Coroutine[Any, Any, T]]) -> AsyncIterator[T]:
    """Messages as they come, for `async for`.

    Args:
        inlet: Whence they come.
        slowly: Makes a coroutine that waits for the next; it ends the iteration with StopAsyncIteration.
    """
    if isinstance(inlet, PyInlet):
        return _Arrivals(inlet, slowly)
    arrivals: AsyncIterator[T] = NativeArrivals(inlet, slowly)
    return arrivals


class _Arrivals(AsyncIterator[T]):
    """In Python, the coroutine of `__anext__` costs a third of the whole way."""

    def __init__(self, inlet: Inlet, slowly: Callable[[], Coroutine[Any, Any, T]]) -> None:
        self._inlet = inlet
        self._slowly = slowly

    async def __anext__(self) -> T:
        message: T = self._inlet.soon()
        return await self._slowly() if message is NOTHING else message
