"""RAW files of Prophesee, in EVT3 or EVT2: lines of text that begin with %, then words.

Time is exact to the microsecond over hours and silences: each wrap is written. Where a file begins more than
an hour after 0, the line `% t0` says what to add, as faery writes it too.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cortex.evt3 import EventCodecError, EventColumns, Evt3Decoder, Evt3Encoder
from neurosim_core.io.event_file import (
    EventFileError,
    read_header,
    read_words,
    split_blocks,
)
from neurosim_core.io.evt2 import Evt2Decoder, Evt2Encoder
from neurosim_core.packets import EventArrays

_SIZE_MAX = 2048
_HOUR_US = 3_600_000_000
_GAP_MAX_US = 48 * _HOUR_US


class RawSource:
    """Reads a RAW file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.notes: list[str] = []
        self._file = open(path, "rb")  # noqa: SIM115 (closed by close())
        try:
            header = read_header(self._file)
            self._begin = self._file.tell()
            self._encoding = _encoding(header, path)
            self._t0_us = int(header["t0"]) if re.fullmatch(r"\d+", header.get("t0", "")) else 0
            self.size = _size(header)
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        word = 2 if self._encoding == "evt3" else 4
        evt2, evt3 = Evt2Decoder(), Evt3Decoder()
        for position, data in read_words(self._file, self._begin, word, self.notes):
            try:
                if self._encoding == "evt3":
                    events = EventArrays(*evt3.decode(data, width=_SIZE_MAX, height=_SIZE_MAX))
                else:
                    events = evt2.decode(data)
            except EventCodecError as error:
                raise EventFileError(f"{self._path}, after byte {position}: {error}") from None
            if self._t0_us:
                events = events._replace(t=events.t + self._t0_us)
            if len(events.t):
                yield events


class RawSink:
    """Writes a RAW file."""

    def __init__(self, path: Path, *, width: int, height: int, encoding: str = "evt3") -> None:
        if max(width, height) > _SIZE_MAX:
            raise EventFileError(f"RAW files hold at most 2048 x 2048 pixels, not {width} x {height}")
        self._path, self._size, self._encoding = path, (width, height), encoding
        self._file = open(path, "wb")  # noqa: SIM115 (closed by close())
        self._encoder: Any = None
        self._t0_us = self._last_us = 0

    def write(self, events: EventArrays) -> None:
        """See `EventSink.write`."""
        for block in split_blocks(events):
            if self._encoder is None:
                self._begin(int(block.t[0]))
            if np.diff(block.t, prepend=self._last_us).max() > _GAP_MAX_US:
                raise EventFileError(f"{self._path}: a RAW file holds no silence of more than 48 hours")
            self._last_us = int(block.t[-1])
            times = block.t - self._t0_us if self._t0_us else block.t
            if self._encoding == "evt2":
                words = self._encoder.encode(block._replace(t=times))
            else:
                columns = EventColumns(times, block.x, block.y, block.polarity)
                words = self._encoder.encode(
                    columns, width=self._size[0], height=self._size[1], end_us=self._last_us
                )
            self._file.write(words.data)

    def close(self) -> None:
        """Complete the file. Closing twice is allowed."""
        if not self._file.closed:
            if self._encoder is None:
                self._begin(0)
            self._file.close()

    def _begin(self, first_us: int) -> None:
        if first_us < 0:
            raise EventFileError(f"RAW files hold no time before 0, got {first_us} us")
        width, height = self._size
        self._t0_us = first_us if first_us > _HOUR_US else 0
        self._last_us = first_us if self._t0_us else 0
        version, name = ("3.0", "EVT3") if self._encoding == "evt3" else ("2.0", "EVT2")
        lines = [
            f"evt {version}",
            f"format {name};height={height};width={width}",
            f"geometry {width}x{height}",
        ]
        lines += [f"t0 {self._t0_us}"] if self._t0_us else []
        self._file.write("".join(f"% {line}\n" for line in [*lines, "end"]).encode())
        evt3 = self._encoding == "evt3"
        self._encoder = Evt3Encoder(begin_us=0, epochs_max=1 << 20) if evt3 else Evt2Encoder()


def _encoding(header: dict[str, str], path: Path) -> str:
    named = header.get("format", "").partition(";")[0] or "EVT" + header.get("evt", "").partition(".")[0]
    if named not in ("EVT2", "EVT3"):
        what = "has no header" if not header else f"holds {named!r}"
        raise EventFileError(f"{path} {what}; RAW files of EVT2 and EVT3 can be read")
    return named.lower()


def _size(header: dict[str, str]) -> tuple[int, int] | None:
    found = re.fullmatch(r"(\d+)x(\d+)", header.get("geometry", ""))
    if found:
        return int(found[1]), int(found[2])
    values = dict(re.findall(r"(width|height)=(\d+)", header.get("format", "")))
    return (int(values["width"]), int(values["height"])) if len(values) == 2 else None
