"""Waiting for a subscriber's sockets on an asyncio loop, without a thread and without `zmq.asyncio`.

`zmq.asyncio` costs 10 to 15 us a message; watching the sockets' descriptors and reading what has arrived
costs less than 1 us.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any, Generic, TypeVar

from cortex.context import Closed
from cortex.fast_receive import NOTHING, PAUSE_COUNT, PAUSE_NS
from cortex.intake import Intake
from cortex.wakeup import Wakeup

T = TypeVar("T")
monotonic_ns = time.monotonic_ns

WAIT_MAX_S = 0.1


class LoopReader:
    """Wakes the tasks of one loop that wait for a subscriber.

    Args:
        watched: Returns the descriptors to watch, and a number that changes with them.
        generation: Returns that number alone.
        on_wake: Called with a descriptor that has become readable.
    """

    def __init__(
        self,
        watched: Callable[[], tuple[int, list[int]]],
        generation: Callable[[], int],
        on_wake: Callable[[int], None],
    ) -> None:
        self.loop = asyncio.get_running_loop()
        self._watched = watched
        self._current = generation
        self._on_wake = on_wake
        self._generation = -1
        self._wanted: list[int] = []
        self._fds: set[int] = set()
        self._waiters: set[asyncio.Future[None]] = set()
        self._timer: asyncio.TimerHandle | None = None

    async def wait(self, timeout_s: float) -> None:
        """Return when something may have come, at the latest after the time."""
        self._watch()
        self._set_timer(self.loop.time() + timeout_s)
        waiter: asyncio.Future[None] = self.loop.create_future()
        self._waiters.add(waiter)
        try:
            await waiter
        finally:
            self._waiters.discard(waiter)

    def _watch(self) -> None:
        if self._current() != self._generation:  # a number may have been closed and given out again
            self._forget()
            self._generation, self._wanted = self._watched()
        if len(self._fds) < len(self._wanted):
            for fd in self._wanted:
                if fd not in self._fds:
                    with contextlib.suppress(OSError):  # its publisher has left since: another number follows
                        self.loop.add_reader(fd, self._wake, fd)
                        self._fds.add(fd)

    def _set_timer(self, when_s: float) -> None:
        """Wake all at that time or earlier: one timer serves a stream that waits thousands of times."""
        if self._timer is not None:
            if self._timer.when() <= when_s:
                return
            self._timer.cancel()
        self._timer = self.loop.call_at(when_s, self._on_time)

    def _on_time(self) -> None:
        self._timer = None
        for waiter in self._waiters:
            _resolve(waiter)

    def _wake(self, fd: int) -> None:
        self._on_wake(fd)
        if not self._waiters:
            # Nobody waits now: a readable descriptor would spin the loop until somebody reads it.
            self.loop.remove_reader(fd)
            self._fds.discard(fd)
        for waiter in self._waiters:
            _resolve(waiter)

    def _forget(self) -> None:
        for fd in self._fds:
            self.loop.remove_reader(fd)
        self._fds.clear()

    def stop(self) -> None:
        """Leave the loop; may be called from any thread."""

        def leave() -> None:
            self._forget()
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None  # a task that goes on to wait needs another
            for waiter in self._waiters:
                _resolve(waiter)

        if not self.loop.is_closed():
            self.loop.call_soon_threadsafe(leave)


def _resolve(waiter: asyncio.Future[None]) -> None:
    if not waiter.done():
        waiter.set_result(None)


class Receiver(Generic[T]):
    """Iterates; unlike a generator it goes on after an exception, such as one publisher's `TypeMismatch`."""

    def __init__(self, receive: Callable[[], T]) -> None:
        self._receive = receive

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        try:
            return self._receive()
        except Closed:
            raise StopIteration from None


class AsyncReceiver(AsyncIterator[T]):
    """Takes the messages of one subscriber on a running loop, until it is closed.

    Args:
        intake: Reads its sockets.
        wakeup: Wakes those that wait for it.
        take: Takes the next message if it is there, else `NOTHING`.
        watched: As of `LoopReader`.
        generation: As of `LoopReader`.
    """

    def __init__(
        self,
        intake: Intake,
        wakeup: Wakeup,
        take: Callable[[], Any],
        watched: Callable[[], tuple[int, list[int]]],
        generation: Callable[[], int],
    ) -> None:
        self._fast_receive, self._queue = intake.fast_receive, intake.queue
        self._wakeup = wakeup
        self._take = take
        self._watched = watched
        self._generation = generation
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
        """Take the next message.

        Raises:
            TimeoutError: None came in time.
        """
        self._fast_receive.left -= 1
        if self._fast_receive.left >= 0 and monotonic_ns() < self._fast_receive.until_ns:
            message: T = self._take()
            if message is not NOTHING:
                return message
        return await self._wait(timeout_s, look=True)

    async def _wait(self, timeout_s: float | None, *, look: bool) -> T:
        """Take the next message as soon as it is there; without a `look` now if there was one in vain."""
        fast_receive = self._fast_receive
        reader: LoopReader | None = None
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            if look and (
                fast_receive.left <= 0 or monotonic_ns() >= fast_receive.until_ns
            ):  # others want to run, too
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
            if reader is None:  # not before: other tasks of the loop may have made it meanwhile
                reader = self._reader_of_loop()
            await reader.wait(min(left_s, WAIT_MAX_S))
            fast_receive.left, fast_receive.until_ns = PAUSE_COUNT - 1, monotonic_ns() + PAUSE_NS

    def _reader_of_loop(self) -> LoopReader:
        reader = self._reader
        if reader is None or reader.loop is not asyncio.get_running_loop():
            self.stop()
            reader = self._reader = LoopReader(self._watched, self._generation, self._on_wake)
        return reader

    def _on_wake(self, fd: int) -> None:
        if fd == self._wakeup.fd:
            self._wakeup.clear()

    def stop(self) -> None:
        """Leave the loop."""
        if self._reader is not None:
            self._reader.stop()
