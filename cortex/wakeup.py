"""A file descriptor that wakes a thread out of `poll`."""

from __future__ import annotations

import contextlib
import os


class Wakeup:
    """Readable after `set` until `clear`; may be used from any thread."""

    def __init__(self) -> None:
        self.fd, self._write = os.pipe()
        os.set_blocking(self.fd, False)
        os.set_blocking(self._write, False)
        self._is_set = False

    def set(self) -> None:
        """Make the descriptor readable."""
        with contextlib.suppress(BlockingIOError):  # full: it is readable already
            os.write(self._write, b"\0")
        self._is_set = True  # after that: who sees it finds something to read

    def clear(self) -> None:
        """Make it unreadable again; costs nothing if it is not set."""
        if not self._is_set:
            return
        self._is_set = False
        with contextlib.suppress(BlockingIOError):
            while len(os.read(self.fd, 4096)) == 4096:
                pass

    def __del__(self) -> None:
        for fd in (self.fd, self._write):
            with contextlib.suppress(OSError):
                os.close(fd)
