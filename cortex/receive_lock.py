"""A lock that its holder may keep while it waits for input, and that it gives up when somebody else asks."""

from __future__ import annotations

import sys
import threading
from types import FrameType

PATIENCE_S = 2.0
"""After so long the holder may be the one who asks, or nobody: a receiver gives the lock up within 20 ms."""


class ReceiveLock:
    """A receiver holds `lock` while it blocks in a socket: the quickest way to wait for a message.

    Everybody else enters with `with`, which counts as `waiting` until the lock is theirs. A receiver looks at
    that before it blocks, and blocks for short times only. The exception of a signal handler may come between
    taking the lock and the block that gives it back: then nobody holds it, and who waits long takes it over.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._guard = threading.Lock()
        self.waiting = 0
        self._takeovers = 0

    def __enter__(self) -> None:
        if self.lock.acquire(blocking=False):
            return
        with self._guard:
            self.waiting += 1
        ownerless_since = -1
        try:
            while not self.lock.acquire(timeout=PATIENCE_S):
                if self._is_used_below(sys._getframe(1)):
                    raise RuntimeError(
                        "a signal handler cannot use a subscriber that it has interrupted while it receives: "
                        "let the handler set a flag, or raise an exception"
                    )
                with self._guard:
                    ownerless = not any(map(self._holds, sys._current_frames().values()))
                    # seen twice, as a holder may only just leave
                    if ownerless and ownerless_since == self._takeovers:
                        self._takeovers += 1
                        # unless it was given back just now, it is ours as it is
                        self.lock.acquire(blocking=False)
                        return
                    ownerless_since = self._takeovers if ownerless else -1
        finally:
            with self._guard:
                self.waiting -= 1

    def __exit__(self, *_: object) -> None:
        self.lock.release()

    def _holds(self, frame: FrameType | None) -> bool:
        """Return whether a thread, by its innermost frame, uses this lock, and does not wait for it."""
        while frame is not None and not self._is_own(frame):
            if frame.f_code is ReceiveLock.__enter__.__code__:
                wanted: ReceiveLock = frame.f_locals["self"]
                if wanted is self:
                    return self._is_used_below(frame.f_back)
            frame = frame.f_back
        return frame is not None

    def _is_used_below(self, frame: FrameType | None) -> bool:
        """Return whether somebody else's function has been called from one that uses this lock."""
        others = False
        while frame is not None:
            own = self._is_own(frame)
            if own and others:
                return True
            others |= not own
            frame = frame.f_back
        return False

    def _is_own(self, frame: FrameType) -> bool:
        """Return whether a function belongs to an object that uses this lock."""
        is_ours: bool = frame.f_globals.get("__package__") == __package__
        return is_ours and getattr(frame.f_locals.get("self"), "_receive_lock", None) is self
