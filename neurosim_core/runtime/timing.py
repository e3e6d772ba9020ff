"""Wall-clock times of the phases of a run."""

from __future__ import annotations

import time


class timed:
    """Adds the wall-clock time of a block to a phase; a class, as it is entered ten times in a period."""

    __slots__ = ("_begin", "_phase", "_wall_s")

    def __init__(self, wall_s: dict[str, float], phase: str) -> None:
        self._wall_s = wall_s
        self._phase = phase

    def __enter__(self) -> None:
        self._begin = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._wall_s[self._phase] += time.perf_counter() - self._begin
