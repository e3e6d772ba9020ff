"""Waiting for a subscriber's sockets on an asyncio loop, without a thread and without `zmq.asyncio`.

`zmq.asyncio` costs 10 to 15 us a message; watching one descriptor for all sockets and reading what has
arrived costs less than 1 us.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING, Any, TypeVar

from cortex.context import Closed
from cortex.fast_receive import NOTHING, PAUSE_COUNT, PAUSE_NS

if TYPE_CHECKING:
    from cortex.subscriber import Subscriber

T = TypeVar("T")
monotonic_ns = time.monotonic_ns

WAIT_MAX_S = 0.1


class LoopReader:
    """Wakes the tasks of one loop that wait for a subscriber."""

    def __init__(self, subscriber: Subscriber[Any]) -> None:
        self.loop = asyncio.get_running_loop()
        self._subscriber = subscriber
        self._is_watching = False
        self._waiters: set[asyncio.Future[None]] = set()
        self._timer: asyncio.TimerHandle | None = None

    async def wait(self, timeout_s: float) -> None:
        """Return when something may have come, at the latest after the time."""
        if not self._is_watching:
            self.loop.add_reader(self._subscriber.fd, self._wake)
            self._is_watching = True
        self._set_timer(self.loop.time() + timeout_s)
        waiter: asyncio.Future[None] = self.loop.create_future()
        self._waiters.add(waiter)
        try:
            await waiter
        finally:
            self._waiters.discard(waiter)

    def _set_timer(self, when_s: float) -> None:
        """Wake all at that time or earlier: one timer serves a stream that waits thousands of times."""
        if self._timer is not None:
            if self._timer.when() <= when_s:
                return
            self._timer.cancel()
        self._timer = self.loop.call_at(when_s, self._on_time)

    def _on_time(self) -> None:
        self._timer = None
        self._wake_all()

    def _wake(self) -> None:
        self._subscriber.wakeup.clear()
        if not self._waiters:
            # Nobody waits now: a readable descriptor would spin the loop until somebody reads it.
            self._forget()
        self._wake_all()

    def _wake_all(self) -> None:
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)

    def _forget(self) -> None:
        if self._is_watching:
            self.loop.remove_reader(self._subscriber.fd)
            self._is_watching = False

    def stop(self) -> None:
        """Leave the loop; may be called from any thread."""

        def leave() -> None:
            self._forget()
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None  # a task that goes on to wait needs another
            self._wake_all()

        if not self.loop.is_closed():
            self.loop.call_soon_threadsafe(leave)


class AsyncReceiver(AsyncIterator[T]):
    """Takes the messages of one subscriber on a running loop, until it is closed."""

    def __init__(self, subscriber: Subscriber[T]) -> None:
        self._subscriber = subscriber
        self._fast_receive, self._queue = subscriber._fast_receive, subscriber._queue
        self._take = subscriber._take_now
        self._reader: LoopReader | None = None

    async def __anext__(self) -> T:
        message: T = self._fast_receive.soon()
        if message is not NOTHING:
            return message
        try:
            found_nothing = self._fast_receive.is_open and self._fast_receive.exhausted and not self._queue
            return await self._wait(None, look=not found_nothing)
        except Closed:
            raise StopAsyncIteration from None

    async def receive(self, timeout_s: float | None) -> T:
        """Take the next message, or raise TimeoutError."""
        message: T = self._fast_receive.soon()
        return message if message is not NOTHING else await self._wait(timeout_s, look=True)

    async def _wait(self, timeout_s: float | None, *, look: bool) -> T:
        """Take the next message as soon as it is there; without a `look` now if there was one in vain."""
        fast_receive = self._fast_receive
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            may_go_on = fast_receive.left > 0 and monotonic_ns() < fast_receive.until_ns
            if look and not may_go_on:  # others want to run, too
                await asyncio.sleep(0)
                fast_receive.left, fast_receive.until_ns = PAUSE_COUNT - 1, monotonic_ns() + PAUSE_NS
            message: T = self._take() if look else NOTHING
            if message is not NOTHING:
                return message
            look = True
            left_s = WAIT_MAX_S if deadline_s is None else deadline_s - time.monotonic()
            if left_s <= 0.0:
                raise TimeoutError
            if self._queue or not fast_receive.exhausted:  # what came could not be read
                await asyncio.sleep(0)
                continue
            reader = self._reader
            if reader is None or reader.loop is not asyncio.get_running_loop():
                self.stop()
                reader = self._reader = LoopReader(self._subscriber)
            await reader.wait(min(left_s, WAIT_MAX_S))
            fast_receive.left, fast_receive.until_ns = PAUSE_COUNT - 1, monotonic_ns() + PAUSE_NS

    def stop(self) -> None:
        """Leave the loop."""
        if self._reader is not None:
            self._reader.stop()
