"""Large messages through sockets: the body is sent from where it lies, and what waits there is bounded."""

from __future__ import annotations

from collections import defaultdict, deque

import zmq

from cortex.pub_socket import PubSocket

PRIVATE_BYTES = 64 << 20
"""Most bytes of bodies that wait to be sent through lossy sockets."""
STRICT_BYTES = 8 << 20
"""Most that wait for strict ones, which hold up the publisher then: few enough to be sent from the cache."""


class LargeSender:
    """Bodies of one publisher that its sockets still read. The caller holds the sockets' lock."""

    def __init__(self) -> None:
        self._waiting: defaultdict[PubSocket, deque[tuple[zmq.MessageTracker, int]]] = defaultdict(deque)
        """What each socket has still to send, in order, and its bytes."""
        self.waiting_bytes = {False: 0, True: 0}

    def has_room(self, pub_socket: PubSocket, body: memoryview) -> bool:
        """Whether a body more may wait."""
        self.prune()
        size = body.nbytes
        most = max(STRICT_BYTES, 2 * size) if pub_socket.strict else max(PRIVATE_BYTES, 4 * size)
        return self.waiting_bytes[pub_socket.strict] + size <= most

    def send(self, pub_socket: PubSocket, body: memoryview) -> None:
        """Send the body that follows a header; nobody writes there any more. Who took the header gets it."""
        if pub_socket.strict:
            pub_socket.socket.setsockopt(zmq.XPUB_NODROP, 0)
        try:
            tracker = pub_socket.send_uncopied(body)
        finally:
            if pub_socket.strict:
                pub_socket.socket.setsockopt(zmq.XPUB_NODROP, 1)
        self._waiting[pub_socket].append((tracker, body.nbytes))
        self.waiting_bytes[pub_socket.strict] += body.nbytes

    def prune(self) -> None:
        """Let go of what has been sent."""
        for pub_socket, waiting in self._waiting.items():
            while waiting and waiting[0][0].done:
                self.waiting_bytes[pub_socket.strict] -= waiting.popleft()[1]
