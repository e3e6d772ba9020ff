"""The thread that keeps a node connected: discovery, answers to requests, and what its members have due."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import zmq

from cortex.clock import wall_offset_ns
from cortex.codec import MalformedMessage
from cortex.control import control_types
from cortex.discovery import Directory
from cortex.places import Places, Reach
from cortex.pub_socket import PubSockets
from cortex.publisher import Publisher
from cortex.records import StatsReply, StatsRequest
from cortex.service import Server
from cortex.subscriber import Subscriber
from cortex.wakeup import Wakeup
from cortex.wire import REQUEST, control_frame, parse_control, unpack_header

logger = logging.getLogger(__name__)

TICK_MS = 20
TICK_BUSY_MS = 2
BUSY_NS = 300_000_000
"""For so long after a change ticks are short, so that new peers meet quickly."""
CLOCK_STEP_NS = 500_000
"""The others are told of our clock when it has moved by more than this."""
_FRAMES_PER_TURN = 256


class ControlThread:
    """Runs from `start` to `stop`, and then closes places and directory; any thread may call it.

    Lists of publishers and subscribers may change. `on_clock` is called with CLOCK_REALTIME of the registry's
    host less CLOCK_MONOTONIC here [ns], when that has changed.
    """

    def __init__(
        self,
        name: str,
        places: Places,
        directory: Directory,
        server: Server,
        pub_sockets: PubSockets,
        *,
        stats: Callable[[], StatsReply],
        publishers: Sequence[Publisher[Any]],
        subscribers: Sequence[Subscriber[Any]],
        on_clock: Callable[[int], None],
    ) -> None:
        self._name = name
        self._places, self._directory, self._server, self._pub_sockets = (
            places,
            directory,
            server,
            pub_sockets,
        )
        self._stats, self._on_clock = stats, on_clock
        self._publishers, self._subscribers = publishers, subscribers
        self.rejected = 0
        self._replies: deque[tuple[zmq.Socket[bytes], bytes, bytes]] = deque()
        self._wakeup = Wakeup()
        self._stopping = False
        self._busy_until_ns = time.monotonic_ns() + BUSY_NS
        self._clock_offset_ns = wall_offset_ns()
        self._thread = threading.Thread(target=self._run, name=f"{name} control", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def hurry(self) -> None:
        """Look at once, and often for a while."""
        self._busy_until_ns = time.monotonic_ns() + BUSY_NS
        self._wake()

    def stop(self) -> None:
        """End, and wait for it a little."""
        self._stopping = True
        self._wakeup.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(5.0)

    def _wake(self) -> None:
        if threading.current_thread() is not self._thread:
            self._wakeup.set()

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
        for end in (self._send_replies, self._directory.close, self._places.close):
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
                self._read_requests(socket)
        if self._directory.socket in ready:
            self._directory.handle()
        self._send_replies()
        self._tick()

    def _read_requests(self, router: zmq.Socket[bytes]) -> None:
        for _ in range(_FRAMES_PER_TURN):
            try:
                parts = router.recv_multipart(zmq.DONTWAIT)
            except zmq.Again:
                return
            try:
                if len(parts) != 2:
                    raise MalformedMessage(f"a control message of {len(parts)} frames")
                self._answer(router, *parts)
            except MalformedMessage as error:
                self.rejected += 1
                if self.rejected == 1:
                    logger.warning("%s: rejected a control frame: %s", self._name, error)

    def _answer(self, router: zmq.Socket[bytes], identity: bytes, frame: bytes) -> None:
        if unpack_header(frame).kind == REQUEST:
            self._server.handle(frame, partial(self._reply, router, identity))
        else:
            _, header = parse_control(frame, control_types(StatsRequest))
            self._reply(router, identity, control_frame(self._stats(), header.sequence))

    def _reply(self, router: zmq.Socket[bytes], identity: bytes, frame: bytes) -> None:
        self._replies.append((router, identity, frame))
        self._wake()

    def _send_replies(self) -> None:
        while self._replies:
            router, identity, frame = self._replies.popleft()
            with contextlib.suppress(zmq.Again, zmq.ZMQError):  # an asker that is gone gets nothing
                router.send_multipart([identity, frame], zmq.DONTWAIT)

    def _tick(self) -> None:
        now_ns = time.monotonic_ns()
        self._directory.tick(now_ns)
        self._pub_sockets.tick()
        self._pub_sockets.emit_notes()
        offset_ns = self._directory.clock.offset_ns()
        if abs(offset_ns - self._clock_offset_ns) > CLOCK_STEP_NS:
            self._clock_offset_ns = offset_ns
            self._on_clock(offset_ns)
        for publisher in list(self._publishers):
            publisher.tick(now_ns)
        self._top_up(now_ns)

    def _top_up(self, now_ns: int) -> None:
        for subscriber in list(self._subscribers):
            subscriber.dismiss(now_ns)
            if subscriber.must_read or subscriber.has_input:
                subscriber.top_up(now_ns)


def ask_stats(place: Reach, asker: int, timeout_s: float) -> StatsReply:
    """Ask a node for its counters; TimeoutError if it does not answer in time."""
    deadline_s = time.monotonic() + timeout_s
    types = control_types(StatsReply)
    with place.open() as socket:
        socket.send(control_frame(StatsRequest(asker)), zmq.DONTWAIT)
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            if socket.poll(max(1, int(left_s * 1000.0))):
                with contextlib.suppress(MalformedMessage):
                    reply: StatsReply = parse_control(socket.recv(zmq.DONTWAIT), types)[0]
                    return reply
    raise TimeoutError(f"node {place.node:016x} did not answer within {timeout_s} s")
