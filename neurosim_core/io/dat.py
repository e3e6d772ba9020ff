"""DAT files of Prophesee: lines of text that begin with %, then 8 bytes for each event.

A time of 32 bits [us], and a word with the column (14 bits), the row (14 bits) and the polarity (4 bits). So
a file holds 71 minutes.

Reference: Prophesee, "DAT file format".
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from neurosim_core.io.event_file import (
    EventFileError,
    EventSource,
    events_of,
    read_header,
    read_words,
    split_blocks,
)
from neurosim_core.packets import EventArrays

_SIZE_MAX = 1 << 14
_RECORD = np.dtype([("t", "<u4"), ("pixel", "<u4")])
_KINDS = (0x00, 0x0C)
"""Event2d and EventCD: the same layout."""


class DatSource(EventSource):
    """Reads a DAT file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = open(path, "rb")  # noqa: SIM115 (closed by close())

    def begin(self) -> None:
        """Read the header."""
        header = read_header(self._file)
        kind = self._file.read(2)
        self._begin = self._file.tell()
        if len(kind) < 2 or kind[0] not in _KINDS or kind[1] != _RECORD.itemsize or not header:
            raise EventFileError(f"{self._path} is not a DAT file of change detection events")
        known = [header.get(key, "") for key in ("width", "height")]
        is_told = all(re.fullmatch(r"\d+", value) for value in known)
        self.size = (int(known[0]), int(known[1])) if is_told else None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        for _, data in read_words(self._file, self._begin, _RECORD.itemsize, self.notes):
            records = np.frombuffer(data, _RECORD)
            pixel = records["pixel"]
            yield events_of(records["t"], pixel & 0x3FFF, pixel >> 14 & 0x3FFF, pixel >> 28)


class DatSink:
    """Writes a DAT file."""

    def __init__(self, path: Path, *, width: int, height: int) -> None:
        if max(width, height) > _SIZE_MAX:
            raise EventFileError(f"DAT files hold at most 16384 x 16384 pixels, not {width} x {height}")
        self._path = path
        self._file = open(path, "wb")  # noqa: SIM115 (closed by close())
        header = f"% Data file containing CD events.\n% Version 2\n% Height {height}\n% Width {width}\n"
        self._file.write(header.encode() + bytes([0x0C, _RECORD.itemsize]))

    def write(self, events: EventArrays) -> None:
        """See `EventSink.write`."""
        for block in split_blocks(events):
            if int(block.t[0]) < 0 or int(block.t[-1]) >= 1 << 32:
                raise EventFileError(
                    f"{self._path}: DAT files hold times from 0 to 71 minutes, got {block.t[0]} to "
                    f"{block.t[-1]} us; RAW files hold all"
                )
            records = np.empty(len(block.t), _RECORD)
            records["t"] = block.t
            records["pixel"] = (
                block.polarity.astype(np.uint32) << 28 | block.y.astype(np.uint32) << 14 | block.x
            )
            self._file.write(records.data)

    def close(self) -> None:
        """Complete the file."""
        self._file.close()
