"""RAW files of Prophesee, in EVT3 or EVT2: lines of text that begin with %, then words.

EVT2 has one word of 32 bits for each event. The upper four bits say what a word is: an event (0 darker, 1
brighter) with the low 6 bits of its time [us], its column and its row (11 bits each), or the high 28 bits of
the time, which wraps every 4.8 h.

Time is exact to the microsecond over hours and silences: each wrap is written. Where a file begins more than
an hour after 0, the line `% t0` says what to add, as faery writes it too.

Reference: Prophesee, "EVT 2.0 format"; EVT3 is that of `cortex.evt3`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex.evt3 import EventCodecError, EventColumns, Evt3Decoder, Evt3Encoder
from neurosim_core.io.event_file import (
    EventFileError,
    EventSource,
    events_of,
    read_header,
    read_words,
    split_blocks,
)
from neurosim_core.packets import EventArrays

_SIZE_MAX = 2048
_HOUR_US = 3_600_000_000
_GAP_MAX_US = 48 * _HOUR_US
_ON, _TIME_HIGH, _TRIGGER, _OTHERS, _CONTINUED = 0x1, 0x8, 0xA, 0xE, 0xF
_KNOWN = {0x0, _ON, _TIME_HIGH, _TRIGGER, _OTHERS, _CONTINUED}
_HIGH_BITS = 28
_HIGH_MAX = (1 << _HIGH_BITS) - 1
_LOW_BITS = 6


class RawSource(EventSource):
    """Reads a RAW file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = open(path, "rb")  # noqa: SIM115 (closed by close())

    def begin(self) -> None:
        """Read the header."""
        header = read_header(self._file)
        self._begin = self._file.tell()
        self._encoding = _encoding(header, self._path)
        self._t0_us = int(header["t0"]) if re.fullmatch(r"\d+", header.get("t0", "")) else 0
        self.size = _size(header)

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
        """Complete the file."""
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


class Evt2Encoder:
    """Encodes blocks of events, one after the other; time is counted from 0."""

    def __init__(self) -> None:
        self._high = -1

    def encode(self, events: EventArrays) -> NDArray[np.uint8]:
        """Return the words of sorted events that lie on the sensor, none before 0."""
        t, x, y, polarity = events
        if not len(t):
            return np.zeros(0, np.uint8)
        high = t >> _LOW_BITS
        before = np.concatenate([[self._high], high[:-1]])
        wrapped = np.maximum((high >> _HIGH_BITS) - np.maximum(before, 0) // (_HIGH_MAX + 1), 0)
        count = 1 + (high != before) + 2 * wrapped
        end = np.cumsum(count)
        words = np.empty(int(end[-1]), "<u4")
        words[end - 1] = (
            polarity.astype(np.uint32) << 28
            | (t & 0x3F).astype(np.uint32) << 22
            | x.astype(np.uint32) << 11
            | y
        )
        new = np.flatnonzero(high != before)
        words[end[new] - 2] = _TIME_HIGH << 28 | (high[new] & _HIGH_MAX).astype(np.uint32)
        for index in np.flatnonzero(wrapped):  # each wrap is told by the last and the first high half
            begin = int(end[index] - count[index])
            words[begin : begin + 2 * int(wrapped[index])] = np.tile(
                np.array([_TIME_HIGH << 28 | _HIGH_MAX, _TIME_HIGH << 28], np.uint32), int(wrapped[index])
            )
        self._high = int(high[-1])
        return words.view(np.uint8)


class Evt2Decoder:
    """Decodes blocks of words, one after the other."""

    def __init__(self) -> None:
        self._high: int | None = None

    def decode(self, data: Any) -> EventArrays:
        """Return the events of some words; those before the first time are left out."""
        words = np.frombuffer(data, "<u4")
        code = words >> 28
        used = set(np.flatnonzero(np.bincount(code, minlength=16)).tolist())
        if not used <= _KNOWN:
            odd = ", ".join(f"0x{kind:X}" for kind in sorted(used - _KNOWN))
            raise EventCodecError(f"evt2 has no words that begin with {odd}")
        is_high = code == _TIME_HIGH
        highs = (words[is_high] & _HIGH_MAX).astype(np.int64)
        initial = -1 if self._high is None else self._high
        steps = np.diff(highs, prepend=max(initial, 0) & _HIGH_MAX)
        highs += (max(initial, 0) >> _HIGH_BITS) + np.cumsum(steps < -(_HIGH_MAX // 2)) << _HIGH_BITS
        table = np.concatenate([[initial], highs])
        is_event = code <= _ON
        where = np.flatnonzero(is_event)
        high = table[np.cumsum(is_high)[where]]
        if self._high is None and len(where) and high[0] < 0:
            where, high = where[high >= 0], high[high >= 0]
        if len(highs):
            self._high = int(highs[-1])
        events = words[where]
        t = high << _LOW_BITS | events >> 22 & 0x3F
        return events_of(t, events >> 11 & 0x7FF, events & 0x7FF, events >> 28)
