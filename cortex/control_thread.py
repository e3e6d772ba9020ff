"""The thread that keeps a node connected: discovery, answers, and what its members have due."""

from __future__ import annotations

import logging
import select
import threading
import time
from collections.abc import Callable
from typing import Any

import zmq

from cortex.answers import Answers
from cortex.clock import wall_offset_ns
from cortex.discovery import Directory
from cortex.places import Places
from cortex.pub_socket import PubSockets
from cortex.publisher import Publisher
from cortex.subscriber import Subscriber
from cortex.wakeup import Wakeup

logger = logging.getLogger(__name__)

TICK_MS = 20
TICK_BUSY_MS = 2
BUSY_NS = 300_000_000
"""For so long after a change ticks are short, so that new peers meet quickly."""
CLOCK_STEP_NS = 500_000
"""The others are told of our clock when it has moved by more than this."""


class ControlThread:
    """Runs from `start` to `stop`; the other methods may be called before, and by any thread."""

    _places: Places
    _directory: Directory
    _answers: Answers
    _pub_sockets: PubSockets
    _publishers: Callable[[], list[Publisher[Any]]]
    _subscribers: Callable[[], list[Subscriber[Any]]]
    _on_clock: Callable[[], None]

    def __init__(self, name: str) -> None:
        self._name = name
        self._wakeup = Wakeup()
        self._stopping = False
        self._busy_until_ns = time.monotonic_ns() + BUSY_NS
        self.clock_offset_ns = wall_offset_ns()
        """CLOCK_REALTIME of the registry's host less CLOCK_MONOTONIC here, as the others are told [ns]."""
        self._thread = threading.Thread(target=self._run, name=f"{name} control", daemon=True)

    def start(
        self,
        places: Places,
        directory: Directory,
        answers: Answers,
        pub_sockets: PubSockets,
        *,
        publishers: Callable[[], list[Publisher[Any]]],
        subscribers: Callable[[], list[Subscriber[Any]]],
        on_clock: Callable[[], None],
    ) -> None:
        """Begin. Places and directory are closed at the end, by this thread.

        `on_clock` is called when `clock_offset_ns` has changed.
        """
        self._places, self._directory, self._answers, self._pub_sockets = (
            places,
            directory,
            answers,
            pub_sockets,
        )
        self._publishers, self._subscribers, self._on_clock = publishers, subscribers, on_clock
        self._thread.start()

    def wake(self) -> None:
        """Look at once, unless it is this thread which calls."""
        if threading.current_thread() is not self._thread:
            self._wakeup.set()

    def hurry(self) -> None:
        """Look at once, and often for a while."""
        self._busy_until_ns = time.monotonic_ns() + BUSY_NS
        self.wake()

    def stop(self) -> None:
        """End, and wait for it a little."""
        self._stopping = True
        self._wakeup.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(5.0)

    def _run(self) -> None:
        failures = 0
        while not self._stopping:
            try:
                self._step()
            except Exception:  # heartbeats must go on whatever one of our many duties ran into
                failures += 1
                if failures & (failures - 1) == 0:
                    logger.exception("%s: a step of the control thread failed (%d)", self._name, failures)
                time.sleep(TICK_MS * 1e-3)
        for end in (self._answers.send, self._directory.close, self._places.close):
            try:
                end()
            except Exception:
                logger.exception("%s: could not close in order", self._name)

    def _step(self) -> None:
        poller = zmq.Poller()
        poller.register(self._wakeup.fd, zmq.POLLIN)
        routers = self._places.routers
        for socket in (*routers, self._directory.socket):
            if socket is not None:
                poller.register(socket, zmq.POLLIN)
        busy = time.monotonic_ns() < self._busy_until_ns
        ready = dict(poller.poll(TICK_BUSY_MS if busy else TICK_MS))
        if self._wakeup.fd in ready:
            self._wakeup.clear()
        for socket in routers:
            if socket in ready:
                self._answers.handle(socket)
        if self._directory.socket in ready:
            self._directory.handle()
        self._answers.send()
        self._tick()

    def _tick(self) -> None:
        now_ns = time.monotonic_ns()
        self._directory.tick(now_ns)
        self._pub_sockets.tick()
        self._pub_sockets.emit_notes()
        offset_ns = self._directory.clock.offset_ns(now_ns)
        if abs(offset_ns - self.clock_offset_ns) > CLOCK_STEP_NS:
            self.clock_offset_ns = offset_ns
            self._directory.announce()
            self._on_clock()
        for publisher in self._publishers():
            publisher.tick(now_ns)
        self._top_up(self._subscribers(), now_ns)

    def _top_up(self, subscribers: list[Subscriber[Any]], now_ns: int) -> None:
        poll, owners = select.poll(), {}
        for subscriber in subscribers:
            subscriber.dismiss(now_ns)
            if subscriber.must_read:
                subscriber.top_up(now_ns)
            for fd in subscriber.fds():
                owners[fd] = subscriber
                poll.register(fd, select.POLLIN)
        for subscriber in {owners[fd] for fd, _ in poll.poll(0)} if owners else ():
            subscriber.top_up(now_ns)
