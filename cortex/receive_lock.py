"""A lock that its holder may keep while it waits for input, and that it gives up when somebody else asks."""

from __future__ import annotations

import sys
import threading
from types import FrameType

PATIENCE_S = 2.0
"""After so long the holder may be the one who asks: a receiver gives the lock up within 20 ms."""


class ReceiveLock:
    """A receiver holds `lock` while it blocks in a socket: the quickest way to wait for a message.

    Everybody else enters with `with`, which counts as `waiting` until the lock is theirs. A receiver looks at
    that before it blocks, and blocks for short times only.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._guard = threading.Lock()
        self.waiting = 0

    def __enter__(self) -> None:
        if self.lock.acquire(blocking=False):
            return
        with self._guard:
            self.waiting += 1
        try:
            while not self.lock.acquire(timeout=PATIENCE_S):
                if self._is_used_below(sys._getframe(1)):
                    raise RuntimeError(
                        "a signal handler cannot use a subscriber that it has interrupted while it receives: "
                        "let the handler set a flag, or raise an exception"
                    )
        finally:
            with self._guard:
                self.waiting -= 1

    def __exit__(self, *_: object) -> None:
        self.lock.release()

    def _is_used_below(self, frame: FrameType | None) -> bool:
        """Return whether somebody else's function has been called from one that uses this lock."""
        others = False
        while frame is not None:
            own = getattr(frame.f_locals.get("self"), "_receive_lock", None) is self
            if own and others:
                return True
            others |= not own
            frame = frame.f_back
        return False
