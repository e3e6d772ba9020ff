"""A node's XPUB sockets: who is attached to which publisher, and how its frames reach them."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import zmq

from cortex.context import Frames, new_socket
from cortex.wire import parse_attach_key, parse_resume_key

if TYPE_CHECKING:
    from cortex.broadcast import Listener
    from cortex.fanout import Fanout

logger = logging.getLogger(__name__)

# As enums they cost a microsecond or two where they are joined or masked.
DONTWAIT, SNDMORE = int(zmq.DONTWAIT), int(zmq.SNDMORE)
EVENTS, POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)

ATTACHED_MAX = 16_384
LOOK_MAX_NS = 5_000_000
"""A publisher reads who has come and gone for so long at a time; others may send more than it can read."""


@dataclass(eq=False)
class PubSocket:
    """One XPUB socket.

    A strict socket refuses a message for which some reader's queue is full (back-pressure); a lossy one drops
    it for that reader, which sees the gap in the sequence.
    """

    socket: zmq.Socket[bytes]
    strict: bool
    local: bool
    listener: Listener | None = None

    def __post_init__(self) -> None:
        self._frames = Frames(self.socket)
        self.send: Callable[..., object] = self._frames.send

    def send_uncopied(self, body: memoryview) -> zmq.MessageTracker:
        """Send a frame without a copy; the tracker says when its memory is free."""
        tracker = self.socket.send(body, DONTWAIT, copy=False, track=True)
        assert tracker is not None
        return tracker

    def close(self) -> None:
        """Close the socket; queued frames are still sent for a second."""
        self._frames.close()
        self.socket.close()

    def try_send(self, frame: bytes, flags: int = 0) -> bool:
        """Send one frame; False if a strict reader's queue is full."""
        try:
            self.send(frame, DONTWAIT | flags)
        except zmq.Again:
            return False
        return True

    def send_anyway(self, frame: bytes, flags: int = 0) -> None:
        """Send one frame to all readers with room in their queues; the others lose it."""
        self.socket.setsockopt(zmq.XPUB_NODROP, 0)
        try:
            self.send(frame, DONTWAIT | flags)
        finally:
            self.socket.setsockopt(zmq.XPUB_NODROP, 1)


def open_pub_socket(
    address: str,
    *,
    strict: bool,
    local: bool,
    listener: Listener | None = None,
    secure: Callable[[zmq.Socket[bytes]], None] | None = None,
) -> PubSocket:
    """Bind an XPUB socket."""
    socket = new_socket(zmq.XPUB, tcp=not local)
    if strict:
        socket.setsockopt(zmq.XPUB_NODROP, 1)
    if secure is not None:
        secure(socket)
    try:
        socket.bind(address)
    except zmq.ZMQError:
        socket.close(0)
        raise
    return PubSocket(socket, strict, local, listener)


class PubSockets:
    """All sockets of a node under one lock, and the publishers whose readers come and go through them."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._pub_sockets: list[PubSocket] = []
        self._publishers: dict[int, Fanout] = {}
        self._attached: dict[bytes, PubSocket] = {}
        self._notes: deque[str] = deque(maxlen=100)
        self._refreshed_ns = 0
        self.closed = False

    def add(self, pub_socket: PubSocket) -> None:
        """Take an socket into service."""
        with self.lock:
            self._pub_sockets.append(pub_socket)

    def register(self, source: int, publisher: Fanout) -> None:
        """Tell a publisher from now on who attaches to its source."""
        with self.lock:
            self._publishers[source] = publisher

    def unregister(self, source: int) -> None:
        """Forget a publisher."""
        with self.lock:
            self._publishers.pop(source, None)

    def refresh(self) -> None:
        """Read who has come and gone; the caller holds the lock."""
        self._refreshed_ns = time.monotonic_ns()
        for pub_socket in self._pub_sockets:
            until_ns = time.monotonic_ns() + LOOK_MAX_NS
            while int(pub_socket.socket.get(EVENTS)) & POLLIN and time.monotonic_ns() < until_ns:
                try:
                    event = pub_socket.socket.recv(DONTWAIT)
                except zmq.Again:
                    break
                self._handle(pub_socket, event)

    def refresh_if_older(self, stamp_ns: int) -> None:
        """Do `refresh`, unless that was after a time of the monotonic clock [ns], for whichever publisher."""
        if self._refreshed_ns < stamp_ns:
            self.refresh()

    def note(self, text: str) -> None:
        """Say that something goes wrong; the caller holds the lock, so no handler of a log may run."""
        self._notes.append(text)

    def emit_notes(self) -> None:
        """Log what was noted; the caller holds no lock."""
        while self._notes:
            logger.warning("%s", self._notes.popleft())

    def tick(self) -> None:
        """Do `refresh`, and forget readers that left early, unless a publisher is at it."""
        if self.lock.acquire(blocking=False):
            try:
                if not self.closed:
                    self.refresh()
                    for pub_socket in self._pub_sockets:
                        if pub_socket.listener is not None:
                            pub_socket.listener.forget()
            finally:
                self.lock.release()

    def _handle(self, pub_socket: PubSocket, event: bytes) -> None:
        key = event[1:]
        request = parse_attach_key(key)
        if request is None:
            resumed = parse_resume_key(key)
            if resumed is not None and event[0] == 1 and resumed[0] in self._publishers:
                self._publishers[resumed[0]].resume(pub_socket, *resumed[1:])
            return
        publisher = self._publishers.get(request.source)
        if publisher is None:
            return
        if event[0] == 1:
            if len(self._attached) >= ATTACHED_MAX:
                return
            self._attached[key] = pub_socket
            publisher.attach(pub_socket, key, request)
        elif self._attached.pop(key, None) is not None:
            publisher.detach(pub_socket, request)

    def close(self) -> None:
        """Close the sockets; queued frames are still sent for a second."""
        with self.lock:
            self.closed = True
            for pub_socket in self._pub_sockets:
                pub_socket.close()
            self._pub_sockets.clear()


class Backoff:
    """Sleeps that grow from 50 us to 1 ms, until a deadline."""

    def __init__(self, timeout_s: float) -> None:
        self._deadline_s = time.monotonic() + timeout_s
        self._pause_s = 50e-6

    def wait(self) -> bool:
        """Sleep once; False when the deadline has passed."""
        left_s = self._deadline_s - time.monotonic()
        if left_s <= 0.0:
            return False
        time.sleep(min(self._pause_s, left_s))
        self._pause_s = min(1.3 * self._pause_s, 1e-3)
        return True
