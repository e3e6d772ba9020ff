"""Events as text, one a line: `t,x,y,p`, t in whole microseconds.

Other files are read too: columns separated by commas, blanks or semicolons; in the order of a header such as
`x,y,polarity,timestamp`, else t, x, y, p; times with a decimal point are seconds; polarity may be -1 or 1; a
first line `WIDTH HEIGHT`, or `%geometry:WIDTH,HEIGHT`, tells the sensor.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurosim_core.io.event_file import EventFileError, events_of, split_blocks
from neurosim_core.packets import EventArrays

_BLOCK_LINES = 200_000
_NAMES = {
    **dict.fromkeys(("t", "ts", "time", "timestamp", "t_us", "timestamps"), "t"),
    **{"x": "x", "y": "y"},
    **dict.fromkeys(("p", "polarity", "on", "pol"), "p"),
}
_HEADER_LINES_MAX = 100


class CsvSource:
    """Reads events from text."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.notes: list[str] = []
        self._columns: tuple[str, ...] = ("t", "x", "y", "p")
        self._skip, self._delimiter, self._in_seconds = 0, ",", False
        self.size = self._read_header()

    def close(self) -> None:
        """Nothing is open between blocks."""

    def _read_header(self) -> tuple[int, int] | None:
        size = None
        with open(self._path, encoding="utf-8", errors="replace") as file:
            for line in islice(file, _HEADER_LINES_MAX):
                text = line.strip()
                words = re.split(r"[,;\s]+", text.lstrip("%# "))
                if geometry := re.search(r"geometry:?\s*(\d+)\D(\d+)", text):
                    size = int(geometry[1]), int(geometry[2])
                elif len(words) >= 4 and {_NAMES.get(word.lower()) for word in words} >= {"t", "x", "y", "p"}:
                    self._columns = tuple(_NAMES.get(word.lower(), "") for word in words)
                elif len(words) == 2 and all(word.isdigit() for word in words) and not text.startswith("%"):
                    size = int(words[0]), int(words[1])
                elif text and text[0] not in "%#":
                    if len(words) < 4 or not re.fullmatch(r"[-+.\deE]+", words[0]):
                        raise EventFileError(f"{self._path} is not a text of events: {text[:60]!r}")
                    self._delimiter = next((mark for mark in ",;" if mark in text), "")
                    self._in_seconds = "." in words[self._columns.index("t")]
                    break
                self._skip += 1
        return size

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        place = [self._columns.index(name) for name in ("t", "x", "y", "p")]
        kind = np.float64 if self._in_seconds else np.int64
        number = self._skip
        with open(self._path, encoding="utf-8", errors="replace") as file:
            lines = islice(file, self._skip, None)
            while chunk := list(islice(lines, _BLOCK_LINES)):
                rows = self._rows(chunk, number, kind, place)
                number += len(chunk)
                if len(rows):
                    yield self._events(rows, number)

    def _rows(self, chunk: list[str], number: int, kind: type, place: list[int]) -> NDArray[np.float64]:
        last = chunk[-1]
        try:
            rows = self._load(chunk, kind, place)
        except ValueError as error:
            if last.endswith("\n"):
                raise EventFileError(f"{self._path}, after line {number}: {error}") from None
            rows, last = self._rows(chunk[:-1], number, kind, place) if chunk[1:] else np.zeros((0, 4)), "\n"
            self.notes.append(f"{self._path} ends within a line: it was cut off")
        if not last.endswith("\n") and len(rows):  # a number may be cut, and still be one
            self.notes.append(f"{self._path} ends within a line: it was cut off")
            rows = rows[:-1]
        return rows

    def _load(self, chunk: list[str], kind: type, place: list[int]) -> NDArray[np.float64]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a chunk without data
            rows: NDArray[np.float64] = np.loadtxt(
                chunk, kind, comments=("#", "%"), delimiter=self._delimiter or None, usecols=place, ndmin=2
            )
        return rows

    def _events(self, rows: NDArray[np.float64], number: int) -> EventArrays:
        t = np.rint(rows[:, 0] * 1e6) if self._in_seconds else rows[:, 0]
        rest = rows[:, 1:].astype(np.int64)
        rest[:, 2] = np.where(rest[:, 2] == -1, 0, rest[:, 2])
        if not np.isfinite(t).all() or (rest < 0).any() or (rest > 0xFFFF).any() or (rest[:, 2] > 1).any():
            raise EventFileError(f"{self._path}: an event before line {number} is impossible")
        return events_of(t, *rest.T)


class CsvSink:
    """Writes events as text; the size of the sensor is not in it."""

    def __init__(self, path: Path, *, width: int, height: int) -> None:
        self._file = open(path, "w", encoding="ascii", newline="\n")  # noqa: SIM115 (closed by close())
        self._file.write("t,x,y,p\n")

    def write(self, events: EventArrays) -> None:
        """See `EventSink.write`."""
        for block in split_blocks(events, _BLOCK_LINES):
            columns = (column.tolist() for column in block)
            self._file.write("".join(map("%d,%d,%d,%d\n".__mod__, zip(*columns, strict=True))))

    def close(self) -> None:
        """Complete the file."""
        self._file.close()
