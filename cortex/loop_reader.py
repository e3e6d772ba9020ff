"""Waiting for a subscriber's sockets on an asyncio loop, without a thread and without `zmq.asyncio`.

`zmq.asyncio` costs 10 to 15 us a message; watching the sockets' descriptors and reading what has arrived
costs less than 1 us.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable


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
