"""Counts of a subscriber: messages, gaps, order, payload; and its cost in time and memory."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

WARM = -1
"""Sequence of a message that only shows that the two sides are connected."""
END = -2
"""Sequence of the message after the last one."""

Floats = NDArray[np.float32]
Handler = Callable[[Any, Any], None]

_LARGE_FLOATS = 8192  # from here on the check of a message costs nothing beside its transport


class Finished(Exception):
    """The END message arrived: ends a receive loop from inside its handler."""


def make_payloads(floats: int) -> tuple[Floats, Floats]:
    """Return the two arrays that a publisher sends in turn: all ones and all twos: a torn message shows."""
    return np.full(floats, 1.0, np.float32), np.full(floats, 2.0, np.float32)


class Tally:
    """Counts the messages of one flood; its handlers raise `Finished` at the END message.

    Every message's sequence is checked; the payload's first, middle and last item at every 64th message, and
    at every message of 32 kB or more.

    Args:
        floats: Items of each payload.
        connected: Called at the first message of any kind.
        settle_at: Sequence from which on memory must not grow.
    """

    def __init__(self, floats: int, connected: Callable[[], None], *, settle_at: int = 0) -> None:
        self.report: dict[str, Any] = {
            "rate": 0.0, "received": 0, "lost": 0, "misordered": 0, "corrupt": 0, "grown_kb": 0
        }  # fmt: skip
        self._floats = floats
        self._mask = 0 if floats >= _LARGE_FLOATS else 63
        self._connected = connected
        self._is_connected = False
        self._marks: list[tuple[int, float]] = []
        self._settle_at = settle_at
        self._settled_kb = 0

    def handler(self, *, consume: bool = False) -> Handler:
        """Return the function to call with each message's sequence and payload."""
        expected = 0
        mask = self._mask
        check = self._check
        out = np.zeros(self._floats, np.float32)

        def handle(sequence: int, data: Floats) -> None:
            nonlocal expected
            if sequence == expected:
                expected = sequence + 1
                if not sequence & mask:
                    check(sequence, data)
            else:
                expected = self._jump(sequence, expected, data)

        def copy_and_handle(sequence: int, data: Floats) -> None:
            np.copyto(out, data)
            handle(sequence, out)

        return copy_and_handle if consume else handle

    def _check(self, sequence: int, data: Floats) -> None:
        tag = 1.0 + (sequence & 1)
        if len(data) != self._floats or not (data[0] == tag == data[-1] == data[self._floats // 2]):
            self.report["corrupt"] += 1
        self._marks[1:] = [(sequence - self.report["lost"], time.perf_counter())]
        if self._settle_at and not self._settled_kb and sequence >= self._settle_at:
            self._settled_kb = resident_kb()

    def _jump(self, sequence: int, expected: int, data: Floats) -> int:
        """Take a message that is not the expected one; return what is expected next."""
        if not self._is_connected:
            self._is_connected = True
            self._connected()
        if sequence == END:
            self._finish(expected)
        if sequence == WARM:
            return expected
        if sequence < expected:
            self.report["misordered"] += 1
            return expected
        self.report["lost"] += sequence - expected
        self._check(sequence, data)
        return sequence + 1

    def _finish(self, expected: int) -> None:
        """Count up: the rate is that between the first and the last check."""
        if len(self._marks) > 1:
            (first, begin_s), (last, end_s) = self._marks
            self.report["rate"] = (last - first) / (end_s - begin_s)
        self.report["received"] = expected - self.report["lost"]
        if self._settled_kb:
            self.report["grown_kb"] = resident_kb() - self._settled_kb
        raise Finished


def resident_kb() -> int:
    """Return the memory that this process holds now [kB], its shared pages included."""
    pages = int(Path("/proc/self/statm").read_text().split()[1]) if os.path.exists("/proc/self/statm") else 0
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024
