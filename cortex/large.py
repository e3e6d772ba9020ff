"""Large messages through sockets: the body is sent from where it lies, and what waits there is bounded."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import zmq

from cortex.pub_socket import PubSocket

PRIVATE_BYTES = 64 << 20
"""Most bytes of bodies that wait to be sent through lossy sockets, and through strict ones."""


class _Body(NamedTuple):
    tracker: zmq.MessageTracker
    size: int
    strict: bool


class LargeSender:
    """Bodies of one publisher that its sockets still read. The caller holds the sockets' lock."""

    def __init__(self) -> None:
        self._waiting: deque[_Body] = deque()
        self.waiting_bytes = {False: 0, True: 0}
        """Bytes that wait, of lossy and of strict sockets."""

    def has_room(self, pub_socket: PubSocket, size: int) -> bool:
        """Whether so many bytes more may wait."""
        if self._waiting:
            self.prune()
        return self.waiting_bytes[pub_socket.strict] + size <= max(PRIVATE_BYTES, 4 * size)

    def send(self, pub_socket: PubSocket, body: memoryview) -> None:
        """Send the body that follows a header; nobody writes there any more. Who took the header gets it."""
        if pub_socket.strict:
            pub_socket.socket.setsockopt(zmq.XPUB_NODROP, 0)
        try:
            tracker = pub_socket.send_uncopied(body)
        finally:
            if pub_socket.strict:
                pub_socket.socket.setsockopt(zmq.XPUB_NODROP, 1)
        self._waiting.append(_Body(tracker, body.nbytes, pub_socket.strict))
        self.waiting_bytes[pub_socket.strict] += body.nbytes

    def prune(self) -> None:
        """Let go of what has been sent."""
        for _ in range(len(self._waiting)):
            body = self._waiting.popleft()
            if body.tracker.done:
                self.waiting_bytes[body.strict] -= body.size
            else:
                self._waiting.append(body)
