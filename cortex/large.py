"""Large messages through sockets: the body is sent from where it lies, and what waits there is bounded."""

from __future__ import annotations

import ctypes
import weakref
from collections import defaultdict, deque

import numpy as np
import zmq
from numpy.typing import NDArray

from cortex.pub_socket import PubSocket

PRIVATE_BYTES = 64 << 20
"""Most bytes of bodies that wait to be sent through lossy sockets."""
STRICT_BYTES = 8 << 20
"""Most that wait for strict ones, which hold up the publisher then: few enough to be sent from the cache."""
FREE_MAX = 16
"""Memory of so many sent bodies is kept for those that follow: of `PRIVATE_BYTES` or four of them at most."""


class LargeSender:
    """Bodies of one publisher that its sockets still read. The caller holds the sockets' lock."""

    def __init__(self) -> None:
        self._waiting: defaultdict[PubSocket, deque[tuple[zmq.MessageTracker, int]]] = defaultdict(deque)
        """What each socket has still to send, in order, and its bytes."""
        self.waiting_bytes = {False: 0, True: 0}
        self._free: list[NDArray[np.uint8]] = []
        self._lent: dict[int, int] = {}
        """Where memory lies that is in use, and its bytes: up to four times those of the body in it."""

    def acquire(self, size: int) -> NDArray[np.uint8]:
        """Return memory for a body of so many bytes, as large or larger; it is not cleared.

        It is used again once nobody looks at it, sockets included: the C library would give its pages back,
        and to get new ones takes longer than the copy. Any thread may let go of it.
        """
        for index, memory in enumerate(self._free):
            if size <= len(memory) <= 4 * size:
                del self._free[index]
                break
        else:
            del self._free[:1]  # sizes have changed
            memory = np.empty(size, np.uint8)
        lent = (ctypes.c_ubyte * len(memory)).from_buffer(memory.data)
        self._lent[ctypes.addressof(lent)] = len(memory)
        weakref.finalize(lent, self._release, memory).atexit = False
        return np.frombuffer(memoryview(lent), np.uint8)

    def _release(self, memory: NDArray[np.uint8]) -> None:
        del self._lent[memory.ctypes.data]
        kept = sum(map(len, self._free)) + len(memory)
        if len(self._free) < FREE_MAX and kept <= max(PRIVATE_BYTES, 4 * len(memory)):
            self._free.append(memory)

    def forget(self) -> None:
        """Give back the memory of bodies that were sent; those that follow get new memory."""
        self._free.clear()

    def _bytes_of(self, body: memoryview) -> int:
        return self._lent.get(np.frombuffer(body, np.uint8).ctypes.data, body.nbytes)

    def has_room(self, pub_socket: PubSocket, body: memoryview) -> bool:
        """Whether a body more may wait."""
        self.prune()
        size = self._bytes_of(body)
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
        size = self._bytes_of(body)
        self._waiting[pub_socket].append((tracker, size))
        self.waiting_bytes[pub_socket.strict] += size

    def prune(self) -> None:
        """Let go of what has been sent."""
        for pub_socket, waiting in self._waiting.items():
            while waiting and waiting[0][0].done:
                self.waiting_bytes[pub_socket.strict] -= waiting.popleft()[1]
