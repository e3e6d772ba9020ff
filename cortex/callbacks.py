"""The node's callback thread: it runs the callbacks of subscribers and the handlers of services.

A callback that takes long delays other callbacks of its node, but neither heartbeats nor discovery, which
have a thread of their own.
"""

from __future__ import annotations

import inspect
import logging
import select
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from cortex.loop_reader import WAIT_MAX_S
from cortex.subscriber import Subscriber
from cortex.wakeup import Wakeup

logger = logging.getLogger(__name__)


def check_callable(function: object, what: str) -> None:
    """Refuse what the callback thread cannot call.

    Raises:
        TypeError: It is no function, or a coroutine function, which nobody would await.
    """
    if not callable(function):
        raise TypeError(f"{what}, got {function!r:.80}")
    if inspect.iscoroutinefunction(function):
        raise TypeError(
            f"{what}, got the coroutine function {function!r:.80}, which no loop would run: "
            "use `async for`, or asyncio.run_coroutine_threadsafe"
        )


class CallbackThread:
    """Started with the first callback."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._subscribers: list[Subscriber[Any]] = []
        self._jobs: deque[Callable[[], object]] = deque()
        self._wakeup = Wakeup()
        self._thread: threading.Thread | None = None
        self._closed = False
        self._changed = False
        self._serving = False
        self._running: Subscriber[Any] | None = None
        self._alone: Subscriber[Any] | None = None

    def add(self, subscriber: Subscriber[Any]) -> None:
        """Run a subscriber's callback from now on."""
        with self._lock:
            self._subscribers.append(subscriber)
            self._start()
        self._notify()

    def remove(self, subscriber: Subscriber[Any]) -> None:
        """Run it no more; waits up to a second for a call that is under way, unless called from there."""
        with self._lock:
            if subscriber in self._subscribers:
                self._subscribers.remove(subscriber)
        self._notify()
        deadline_s = time.monotonic() + 1.0
        while self._running is subscriber and not self.is_current and time.monotonic() < deadline_s:
            time.sleep(0.5e-3)

    def serve(self) -> None:
        """Jobs will come that must not wait."""
        with self._lock:
            self._serving = True
        self._notify()

    def _notify(self) -> None:
        self._changed = True
        self._wakeup.set()

    def submit(self, job: Callable[[], object]) -> None:
        """Run a function once, after what is under way."""
        self._jobs.append(job)
        with self._lock:
            self._start()
        self._notify()

    @property
    def is_current(self) -> bool:
        """Whether the caller is a callback."""
        return threading.current_thread() is self._thread

    def _start(self) -> None:
        if self._thread is None and not self._closed:
            self._thread = threading.Thread(target=self._run, name=f"{self._name} callbacks", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        poll, owners = self._watch()
        busy: list[Subscriber[Any]] = []
        while not self._closed:
            while self._jobs:
                self._call(self._jobs.popleft())
            if self._changed:
                poll, owners = self._watch()
            alone = self._alone
            if alone is not None and alone.has_one_socket and self._dispatch(alone, block=True):
                continue
            ready = self._ready(poll, owners, busy)
            busy = [subscriber for subscriber in ready if self._dispatch(subscriber)]
            ready, alone = busy, None  # what is closed meanwhile shall be forgotten while we wait

    def _ready(
        self, poll: select.poll, owners: dict[int, Subscriber[Any]], busy: list[Subscriber[Any]]
    ) -> list[Subscriber[Any]]:
        """Wait until a socket may have something, unless some subscriber is busy; returns whom to serve."""
        ready = list(busy)
        for fd, _ in poll.poll(0 if busy else WAIT_MAX_S * 1000.0):
            subscriber = owners.get(fd)
            if subscriber is None:
                self._wakeup.clear()
                continue
            subscriber.wakeup.clear()
            if subscriber not in ready:
                ready.append(subscriber)
        return ready

    def _dispatch(self, subscriber: Subscriber[Any], *, block: bool = False) -> bool:
        self._running = subscriber
        try:
            return subscriber.dispatch(block=block)
        finally:
            self._running = None

    def _watch(self) -> tuple[select.poll, dict[int, Subscriber[Any]]]:
        """What to poll: our own descriptor, and those of the subscribers, by number."""
        self._changed = False  # before looking: what changes meanwhile sets it again
        with self._lock:
            subscribers = list(self._subscribers)
            # Waiting in the only socket is quicker than polling, but a service's request would not wake us.
            self._alone = subscribers[0] if len(subscribers) == 1 and not self._serving else None
        owners = {subscriber.fd: subscriber for subscriber in subscribers}
        poll = select.poll()
        for fd in (self._wakeup.fd, *owners):
            poll.register(fd, select.POLLIN)
        return poll, owners

    def _call(self, job: Callable[[], object]) -> None:
        try:
            job()
        except Exception:
            logger.exception("%s: a job of the callback thread raised", self._name)

    def close(self, timeout_s: float = 2.0) -> bool:
        """Stop after the call that is under way; False if that takes longer than the time given."""
        with self._lock:
            self._closed = True
            thread = self._thread
        self._notify()
        if thread is None or thread is threading.current_thread():
            return True
        thread.join(timeout_s)
        return not thread.is_alive()
