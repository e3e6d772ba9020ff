"""When a run has begun again, as seen by one who only hears its streams, each on its own way."""

from __future__ import annotations

from typing import Literal

_AHEAD_NS = 100_000_000
_SETTLED_NS = 1_000_000_000

Run = Literal["present", "next", "past"]


class Episodes:
    """Sorts messages by the run that they belong to.

    A stream whose stamps or numbers go back has begun again. The first one to do so begins a new run. During
    its first second, others that have not gone back and are 0.1 s ahead still deliver the run before.
    """

    def __init__(self) -> None:
        self._run = 0
        self._newest_ns = 0
        self._last: dict[str, tuple[int, int, int]] = {}

    @property
    def newest_ns(self) -> int:
        """Newest stamp of the present run [ns]."""
        return self._newest_ns

    def sort(self, stream: str, stamp_ns: int, sequence: int) -> Run:
        """Return the run that a message belongs to; with "next", that becomes the present one.

        Args:
            stream: Name of the stream.
            stamp_ns: Stamp of the message [ns].
            sequence: Number of the message in its stream.
        """
        unheard = (max(self._run - 1, 0), stamp_ns, sequence)
        run, last_ns, last_sequence = self._last.get(stream, unheard)
        found: Run = "present"
        if stamp_ns < last_ns or sequence < last_sequence:
            if run == self._run:
                found = "next"
                self._run += 1
                self._newest_ns = stamp_ns
            run = self._run
        elif run < self._run:
            if self._newest_ns >= _SETTLED_NS:
                run = self._run
            elif stamp_ns > self._newest_ns + _AHEAD_NS:
                found = "past"
        self._last[stream] = (run, stamp_ns, sequence)
        if found != "past":
            self._newest_ns = max(self._newest_ns, stamp_ns)
        return found
