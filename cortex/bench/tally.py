"""What a subscriber counts: messages, gaps, order, payload; and what it costs in time and memory."""

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
Handler = Callable[[int, Floats], None]

_LARGE_FLOATS = 8192  # from here on the check of a message costs nothing beside its transport


class Finished(Exception):
    """The END message arrived: ends a receive loop from inside its handler."""


def make_payloads(floats: int) -> tuple[Floats, Floats]:
    """Return the two arrays that a publisher sends in turn: all ones and all twos: a torn message shows."""
    return np.full(floats, 1.0, np.float32), np.full(floats, 2.0, np.float32)


class Tally:
    """Counts the messages of one flood.

    Every message's sequence is checked; the payload's first, middle and last item at every 64th message, and
    at every message of 32 kB or more.
    """

    def __init__(
        self, floats: int, *, connected: Callable[[], None], finish: Callable[[], None], settle_at: int = 0
    ) -> None:
        """Begin with nothing received.

        Args:
            floats: Items of each payload.
            connected: Called at the first message of any kind.
            finish: Called at the END message; may raise `Finished`.
            settle_at: Sequence from which on memory must not grow.
        """
        self.lost = 0
        self.misordered = 0
        self.corrupt = 0
        self.received = 0
        self._floats = floats
        self._mask = 0 if floats >= _LARGE_FLOATS else 63
        self._connected = connected
        self._finish = finish
        self._seen_any = False
        self._first: tuple[int, float] | None = None
        self._last: tuple[int, float] | None = None
        self._settle_at = settle_at
        self._settled_kb: int | None = None

    def handler(self) -> Handler:
        """Return the function to call with each message's sequence and payload."""
        expected = 0
        mask = self._mask
        check = self._check

        def handle(sequence: int, data: Floats) -> None:
            nonlocal expected
            if sequence == expected:
                expected = sequence + 1
                if not sequence & mask:
                    check(sequence, data)
            else:
                expected = self._jump(sequence, expected, data)

        return handle

    def copying_handler(self) -> Handler:
        """Return a handler that also copies every byte of the payload out."""
        handle = self.handler()
        out = np.zeros(self._floats, np.float32)

        def copy_and_handle(sequence: int, data: Floats) -> None:
            np.copyto(out, data)
            handle(sequence, out)

        return copy_and_handle

    def batch_handler(self) -> Callable[[NDArray[Any]], None]:
        """Return the function to call with each structured array of messages (fields stamp_ns and data)."""
        expected = 0

        def handle(records: NDArray[Any]) -> None:
            nonlocal expected
            stamps = records["stamp_ns"]
            count = len(records)
            if stamps[0] == expected and stamps[-1] == expected + count - 1:
                if count > 2 and not (stamps[1:] > stamps[:-1]).all():
                    self.misordered += 1
                expected += count
                self._check(expected - count, records["data"][0])
            else:  # a marker or a gap within the batch
                for record in records:
                    sequence = int(record["stamp_ns"])
                    if sequence == expected:
                        expected += 1
                    else:
                        expected = self._jump(sequence, expected, record["data"])

        return handle

    def report(self) -> dict[str, Any]:
        """Return the counts and the rate [messages/s] between the first and the last check."""
        rate = 0.0
        if self._first is not None and self._last is not None and self._last[1] > self._first[1]:
            rate = (self._last[0] - self._first[0]) / (self._last[1] - self._first[1])
        return {
            "rate": rate,
            "received": self.received,
            "lost": self.lost,
            "misordered": self.misordered,
            "corrupt": self.corrupt,
            "grown_kb": 0 if self._settled_kb is None else resident_kb() - self._settled_kb,
        }

    def _check(self, sequence: int, data: Floats) -> None:
        tag = 1.0 + (sequence & 1)
        if len(data) != self._floats or not (data[0] == tag == data[-1] == data[self._floats // 2]):
            self.corrupt += 1
        mark = (sequence - self.lost, time.perf_counter())
        if self._first is None:
            self._first = mark
        self._last = mark
        if self._settle_at and self._settled_kb is None and sequence >= self._settle_at:
            self._settled_kb = resident_kb()

    def _jump(self, sequence: int, expected: int, data: Floats) -> int:
        """Take a message that is not the expected one; return what is expected next."""
        if not self._seen_any:
            self._seen_any = True
            self._connected()
        if sequence == END:
            self.received = expected - self.lost
            self._finish()
            return expected
        if sequence == WARM:
            return expected
        if sequence < expected:
            self.misordered += 1
            return expected
        self.lost += sequence - expected
        self._check(sequence, data)
        return sequence + 1


def resident_kb() -> int:
    """Return the memory that this process holds now [kB], its shared pages included."""
    pages = int(Path("/proc/self/statm").read_text().split()[1]) if os.path.exists("/proc/self/statm") else 0
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024
