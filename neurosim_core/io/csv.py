"""Events as text, one a line: `t,x,y,p`, t in whole microseconds.

Other files are read too: columns separated by commas, blanks or semicolons; in the order of a header such as
`x,y,polarity,timestamp` or `t [ns], x, y, p`, else t, x, y, p; without a unit, times that are not whole are
seconds; polarity may be -1 or 1; a first line `WIDTH HEIGHT`, or `%geometry:WIDTH,HEIGHT`, tells the sensor.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from neurosim_core.io.event_file import (
    UNITS_US,
    EventFileError,
    EventSource,
    NoEventsError,
    are_seconds,
    events_of,
    in_microseconds,
    split_blocks,
)
from neurosim_core.packets import EventArrays

_BLOCK_LINES = 200_000
_NAMES = {
    **dict.fromkeys(("t", "ts", "time", "timestamp", "t_us", "timestamps"), "t"),
    **{"x": "x", "y": "y"},
    **dict.fromkeys(("p", "polarity", "on", "pol"), "p"),
}
_HEADER_LINES_MAX = 100
_UNIT = re.compile(r"\[([^]]*)\]|\(([^)]*)\)")


class CsvSource(EventSource):
    """Reads events from text."""

    def __init__(self, path: Path, *, unit_us: float | None = None) -> None:
        super().__init__(path)
        self._columns: tuple[str, ...] = ("t", "x", "y", "p")
        self._skip, self._delimiter = 0, ","
        self._kind: type = np.int64  # read twice as fast as others
        self._unit_us = unit_us
        self.size = self._read_header()
        self.knows_unit = self._unit_us is not None

    def _read_header(self) -> tuple[int, int] | None:
        size = None
        with self._open() as file:
            for line in islice(file, _HEADER_LINES_MAX):
                text = line.strip()
                words = re.split(r"[,;\s]+", _UNIT.sub("", text).lstrip("%# "))
                if geometry := re.search(r"geometry:?\s*(\d+)\D(\d+)", text):
                    size = int(geometry[1]), int(geometry[2])
                elif len(words) >= 4 and {_NAMES.get(word.lower()) for word in words} >= {"t", "x", "y", "p"}:
                    self._columns = tuple(_NAMES.get(word.lower(), "") for word in words)
                    units = (UNITS_US.get("".join(unit).strip()) for unit in _UNIT.findall(text))
                    self._unit_us = self._unit_us or next((unit for unit in units if unit is not None), None)
                elif len(words) == 2 and all(word.isdigit() for word in words) and not text.startswith("%"):
                    size = int(words[0]), int(words[1])
                elif text and text[0] not in "%#":
                    self._delimiter = next((mark for mark in ",;" if mark in text), "")
                    first = [text, *islice(file, _HEADER_LINES_MAX)]  # of the numbers of one all may be whole
                    self._kind = np.float64 if re.search(r"[.eE]", "".join(first)) else np.int64
                    try:
                        events_of(0, *self._load([text])[0, 1:])
                    except (ValueError, IndexError):
                        raise NoEventsError(f"{self._path} is not a text of events: {text[:60]!r}") from None
                    break
                self._skip += 1
        return size

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        number, unit_us, is_first = self._skip, self._unit_us, True
        with self._open() as file:
            lines = islice(file, self._skip, None)
            while chunk := list(islice(lines, _BLOCK_LINES)):
                t, *rest = self._rows(chunk, number).T
                number += len(chunk)
                if len(t):
                    if is_first and unit_us is None and are_seconds(t):
                        unit_us = 1e6
                    is_first = False
                    try:
                        events = events_of(in_microseconds(t, unit_us), *rest)
                    except ValueError as error:
                        raise EventFileError(f"{self._path}, before line {number}: {error}") from None
                    yield events

    def _open(self) -> TextIO:
        return open(self._path, encoding="utf-8-sig", errors="replace")

    def _rows(self, chunk: list[str], number: int) -> NDArray[np.float64]:
        """Return t, x, y, p of lines; a last one that was cut off is left out, and noted."""
        is_cut = not chunk[-1].endswith("\n")
        try:
            if is_cut and not self._is_whole(chunk[-1:]):
                self.notes.append(f"{self._path} ends within a line: it was cut off")
                chunk = chunk[:-1]
            return self._load(chunk)
        except ValueError as error:
            raise EventFileError(f"{self._path}, after line {number}: {error}") from None

    def _is_whole(self, line: list[str]) -> bool:
        """Whether a line without an end has all of an event: of numbers only a polarity cannot be cut."""
        try:
            rows = self._load(line)
        except ValueError:
            return False
        return self._columns[-1] == "p" or not len(rows)

    def _load(self, chunk: list[str]) -> NDArray[np.float64]:
        place = [self._columns.index(name) for name in ("t", "x", "y", "p")]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a chunk without data
            warnings.simplefilter("error", DeprecationWarning)  # older NumPy reads 0.5 as the integer 0
            rows: NDArray[np.float64] = np.loadtxt(
                chunk,
                self._kind,
                comments=("#", "%"),
                delimiter=self._delimiter or None,
                usecols=place,
                ndmin=2,
            )
        return rows.reshape(-1, 4)


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
