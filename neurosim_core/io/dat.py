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
    BLOCK_EVENTS,
    BlockChecker,
    EventFileError,
    find_size,
    read_header,
    split_blocks,
)
from neurosim_core.packets import EventArrays

_SIZE_MAX = 1 << 14
_RECORD = np.dtype([("t", "<u4"), ("pixel", "<u4")])
_KINDS = (0x00, 0x0C)
"""Event2d and EventCD: the same layout."""


class DatReader:
    """Reads a DAT file."""

    def __init__(self, path: Path, *, size: tuple[int, int] | None = None) -> None:
        """Open a file.

        Args:
            path: The file.
            size: Width and height of the sensor [px]; None: as the file says, else the smallest that fits.

        Raises:
            EventFileError: It is not a DAT file of change detection events.
            OSError: It cannot be read.
        """
        self._path = path
        self.notes: list[str] = []
        self._file = open(path, "rb")  # noqa: SIM115 (closed by close())
        try:
            header = read_header(self._file)
            kind = self._file.read(2)
            self._begin = self._file.tell()
            if len(kind) < 2 or kind[0] not in _KINDS or kind[1] != _RECORD.itemsize or not header:
                raise EventFileError(f"{path} is not a DAT file of change detection events")
            known = [header.get(key, "") for key in ("width", "height")]
            if size is None and all(re.fullmatch(r"\d+", value) for value in known):
                size = int(known[0]), int(known[1])
            self.width, self.height = size or find_size(self._decode())
        except BaseException:
            self._file.close()
            raise

    def blocks(self) -> Iterator[EventArrays]:
        """See `EventReader.blocks`."""
        self.notes.clear()
        checker = BlockChecker(self._path, width=self.width, height=self.height, notes=self.notes)
        for events in self._decode():
            yield checker.check(events)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _decode(self) -> Iterator[EventArrays]:
        position = self._begin
        while True:
            self._file.seek(position)
            data = self._file.read(BLOCK_EVENTS * _RECORD.itemsize)
            if len(data) % _RECORD.itemsize:
                self.notes.append(f"{self._path} ends within an event: it was cut off")
                data = data[: len(data) - len(data) % _RECORD.itemsize]
            if not data:
                return
            position += len(data)
            records = np.frombuffer(data, _RECORD)
            pixel = records["pixel"]
            yield EventArrays(
                records["t"].astype(np.int64),
                (pixel & 0x3FFF).astype(np.uint16),
                (pixel >> 14 & 0x3FFF).astype(np.uint16),
                (pixel >> 28).astype(np.uint8),
            )


class DatWriter:
    """Writes a DAT file."""

    def __init__(self, path: Path, *, width: int, height: int) -> None:
        """Create a file, replacing one that exists.

        Raises:
            EventFileError: The sensor has more than 16384 columns or rows.
            OSError: It cannot be written.
        """
        if max(width, height) > _SIZE_MAX:
            raise EventFileError(f"DAT files hold at most 16384 x 16384 pixels, not {width} x {height}")
        self._path = path
        self._checker = BlockChecker(path, width=width, height=height)
        self._file = open(path, "wb")  # noqa: SIM115 (closed by close())
        header = f"% Data file containing CD events.\n% Version 2\n% Height {height}\n% Width {width}\n"
        self._file.write(header.encode() + bytes([0x0C, _RECORD.itemsize]))

    def write(self, events: EventArrays) -> None:
        """See `EventWriter.write`."""
        for block in split_blocks(self._checker.check(events)):
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
