"""A lock that its holder may keep while it waits for input, and that it gives up when somebody else asks."""

from __future__ import annotations

import threading


class Turn:
    """A receiver holds `lock` while it blocks in a socket: the quickest way to wait for a message.

    Everybody else enters with `with turn:`, which counts as `waiting` until the lock is theirs. A receiver
    looks at that before it blocks, and blocks for short times only.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._guard = threading.Lock()
        self.waiting = 0
        """How many want the lock."""

    def __enter__(self) -> None:
        if self.lock.acquire(blocking=False):
            return
        with self._guard:
            self.waiting += 1
        try:
            self.lock.acquire()
        finally:
            with self._guard:
                self.waiting -= 1

    def __exit__(self, *_: object) -> None:
        self.lock.release()
