"""Calls of callbacks on the threads of a backend: what they raise is told and counted, and ends nothing."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)

_CLOSE_S = 5.0
"""Longest wait for a call that is under way."""
_TELL_S = 1.0
"""Shortest time between two reports of one callback."""


class Delivery:
    """Hands messages to a callback until it is closed."""

    def __init__(self, callback: Callable[[bytes], None], name: str) -> None:
        self.error_count = 0
        self._callback = callback
        self._name = name
        self._busy = threading.RLock()
        self._closed = False
        self._told_s: float | None = None

    def __call__(self, message: bytes) -> None:
        """Call the callback."""
        with self._busy:
            if self._closed:
                return
            try:
                self._callback(message)
            except Exception:  # whatever it raises: it is not ours
                self._tell()

    def close(self) -> None:
        """Call no more; waits for a call that is under way in another thread."""
        self._closed = True
        if self._busy.acquire(timeout=_CLOSE_S):
            self._busy.release()
        else:
            _log.error("the callback of %s still runs %g s after it was closed", self._name, _CLOSE_S)

    def _tell(self) -> None:
        self.error_count += 1
        now_s = time.monotonic()
        if self._told_s is None or now_s - self._told_s >= _TELL_S:
            self._told_s = now_s
            _log.exception("the callback of %s failed, %d times by now", self._name, self.error_count)
