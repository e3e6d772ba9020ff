"""Files of events: what readers and writers of all formats have in common, and the checks that all share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim_core.packets import NO_EVENTS, EventArrays, Events, Packet, join_events
from neurosim_core.record.disk import naming_file

BLOCK_EVENTS = 1_000_000
"""Events that are read, and held in memory, at a time."""
PACKET_US = 10_000
"""Events that come without packets are put into packets of this length [us]."""
_HEADER_LINE_MAX = 4096
_DISORDER_MAX_US = 10_000
"""Cameras send events of neighbouring rows slightly out of order; what comes later than this is damage."""

_TIME_MAX_US = 1 << 53
"""285 years; float64 holds all whole numbers up to it."""
_RATE_MIN_HZ = 0.05
"""Of a pixel, on average: a camera that sees anything has more events."""
UNITS_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "\N{MICRO SIGN}s": 1.0, "ns": 1e-3}
"""Units of time [us]."""


class EventFileError(ValueError):
    """A file is damaged or not of its format, or its format cannot hold some events."""


class NoEventsError(EventFileError):
    """A file of a format that others use too is whole, and has no events."""


def check_new(path: Path, *, overwrite: bool) -> None:
    """Refuse to replace a file.

    Raises:
        FileExistsError: It is there, and may not be replaced.
    """
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} is already there: add --overwrite, or name another file")


class EventSource:
    """The interface of a reader: it reads the events of one camera from a file of one format.

    Attributes:
        size: Width and height of the sensor [px], where the file says them.
        knows_unit: Whether the file, its format or the user says in which unit times are.
        notes: What a user should know about the file; more may come while it is read.
        packets: Yields what is there besides events, in the order of time; None: nothing ever is.
    """

    size: tuple[int, int] | None = None
    knows_unit = True
    packets: Callable[[], Iterator[Packet]] | None = None

    def __init__(self, path: Path) -> None:
        """Open a file, and no more: what fails later closes it."""
        self._path = path
        self.notes: list[str] = []

    def begin(self) -> None:
        """Read what the file says of itself; called once.

        Raises:
            EventFileError: It is not of the format, or damaged.
        """

    def read(self) -> Iterator[EventArrays]:
        """Yield all events from the first on, as they are in the file, about a million at a time.

        Raises:
            EventFileError: The file is damaged.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Close what is open between blocks."""


class EventSink(Protocol):
    """The interface of a writer; it is made with the path, and width and height of the sensor [px]."""

    def write(self, events: EventArrays) -> None:
        """Append events, which are sorted, on the sensor, and one at least.

        Raises:
            EventFileError: The format cannot hold them.
            OSError: The disk is full.
        """

    def close(self) -> None:
        """Complete the file; called once."""


class EventReader:
    """Reads the events of one camera, in blocks that are checked.

    Args:
        path: The file.
        source: It, opened; closed here.
        size: Width and height of the sensor [px]; None: as the file says, else the smallest that fits.

    Attributes:
        width: Of the sensor [px].
        height: Of the sensor [px].
        notes: What a user should know about the file; complete once all blocks have been read.
        packets: Yields what is there besides events, in the order of time; None: nothing ever is.
    """

    def __init__(self, path: Path, source: EventSource, size: tuple[int, int] | None = None) -> None:
        self._path, self._source, self.notes, self.packets = path, source, source.notes, source.packets
        try:
            source.begin()
            self._first_notes = [*source.notes]
            self.width, self.height = size or source.size or _find_size(source.read())
        except BaseException:
            source.close()
            raise
        if not (size or source.size):
            self._first_notes.append(
                f"the size of the sensor is not in the file: {self.width}x{self.height} is the smallest that "
                "has all events; `neurosim convert --size` makes it larger"
            )
            self.notes[:] = self._first_notes

    def blocks(self) -> Iterator[EventArrays]:
        """Yield all events from the first on, sorted by time, about a million at a time.

        Raises:
            EventFileError: The file is damaged; what was yielded before is intact.
        """
        self.notes[:] = self._first_notes
        checker = BlockChecker(self._path, width=self.width, height=self.height, notes=self.notes)
        held = NO_EVENTS
        for events in self._source.read():
            if not len(events.t):
                continue
            settled_us = int(events.t.max()) - _DISORDER_MAX_US  # no event of later blocks is before it
            first_us = int(events.t.min())
            if len(held.t) < BLOCK_EVENTS:
                first_us = min(first_us, settled_us)
            if len(held.t) and int(held.t.max()) > first_us:
                both = checker.sort(join_events([held, events]))
                end = int(np.searchsorted(both.t, settled_us, "right"))
                held, events = both.rows(slice(end)), both.rows(slice(end, None))
            if len(held.t):
                yield checker.check(held)
            held = events
        yield checker.check(held)
        if not self._source.knows_unit and checker.rate_hz < _RATE_MIN_HZ:
            self.notes.append(
                f"a pixel has an event every {1.0 / checker.rate_hz:.0f} s: if times are nanoseconds, "
                "`neurosim convert --time-unit ns` says so"
            )

    def close(self) -> None:
        """Close the file."""
        self._source.close()


class EventWriter:
    """Writes the events of one camera, which are checked.

    Args:
        path: The file.
        sink: It, opened; closed here.
        width: Of the sensor [px].
        height: Of the sensor [px].

    Attributes:
        write_packet: Takes a packet of another sensor; None: the format has no place for any.
    """

    def __init__(self, path: Path, sink: EventSink, *, width: int, height: int) -> None:
        self._path, self._sink, self._closed = path, sink, False
        self._checker = BlockChecker(path, width=width, height=height)
        keep: Callable[[Packet], None] | None = getattr(sink, "write_packet", None)
        self.write_packet = None if keep is None else naming_file(path)(keep)

    def write(self, events: EventArrays) -> None:
        """Append events, sorted by time.

        Raises:
            EventFileError: The format cannot hold them.
            OSError: The disk is full.
        """
        checked = self._checker.check(events)
        if len(checked.t):
            with naming_file(self._path):
                self._sink.write(checked)

    def close(self) -> None:
        """Complete the file. Closing twice is allowed."""
        if not self._closed:
            self._closed = True
            with naming_file(self._path):
                self._sink.close()


class BlockChecker:
    """Checks the blocks of a file: pixels inside of the sensor, polarity 0 or 1, times in order."""

    def __init__(self, path: Path, *, width: int, height: int, notes: list[str] | None = None) -> None:
        self._path, self._width, self._height = path, width, height
        self._notes = notes
        self._first_us = self._last_us = -_TIME_MAX_US
        self._count = 0
        self._disordered = 0

    @property
    def rate_hz(self) -> float:
        """Events of a pixel so far [1/s], on average; inf where there are less than a thousand."""
        if self._count < 1000:
            return float("inf")
        span_s = 1e-6 * max(1, self._last_us - self._first_us)
        return self._count / (self._width * self._height * span_s)

    def check(self, events: EventArrays) -> EventArrays:
        """Return a block, sorted; a reader's notes say whether it had to be.

        Raises:
            EventFileError: An event is impossible, or times decrease by more than 10 ms.
        """
        t, x, y, polarity = events
        if not len(t):
            return events
        if int(x.max()) >= self._width or int(y.max()) >= self._height or int(polarity.max()) > 1:
            wrong = (x >= self._width) | (y >= self._height) | (polarity > 1)
            first = int(np.argmax(wrong))
            raise EventFileError(
                f"{self._path}: event {self._count + first} is impossible on {self._width}x{self._height} "
                f"pixels: column {x[first]}, row {y[first]}, polarity {polarity[first]}"
            )
        if int(t.max()) > _TIME_MAX_US:
            raise EventFileError(
                f"{self._path}: times must be microseconds, got {int(t.max())}: nanoseconds?"
            )
        if int(t[0]) < self._last_us:
            raise EventFileError(
                f"{self._path}: time goes back by {self._last_us - int(t[0])} us at event {self._count}"
            )
        events = self.sort(events)
        self._first_us = self._first_us if self._count else int(events.t[0])
        self._last_us = int(events.t[-1])
        self._count += len(t)
        return events

    def sort(self, events: EventArrays) -> EventArrays:
        """Return events in the order of time; a reader's notes say whether they had another.

        Raises:
            EventFileError: Times decrease, or a reader's by more than 10 ms.
        """
        late_us = np.maximum.accumulate(events.t) - events.t
        worst_us = int(late_us.max())
        if worst_us > (0 if self._notes is None else _DISORDER_MAX_US):
            where = self._count + int(np.argmax(late_us))
            raise EventFileError(f"{self._path}: time goes back by {worst_us} us at event {where}")
        if worst_us > 0 and self._notes is not None:
            self._disordered += int(np.count_nonzero(late_us))
            note = f"{self._disordered} events were out of order, by less than 10 ms, and have been sorted"
            self._notes[:] = [n for n in self._notes if "out of order" not in n] + [note]
            return events.rows(np.argsort(events.t, kind="stable"))
        return events


class PacketCutter:
    """Puts events that come in blocks into packets, which end at multiples of 10 ms.

    Args:
        send: Takes each packet.
        width: Of the sensor [px].
        height: Of the sensor [px].
        sensor: Name of the camera.
    """

    def __init__(self, send: Callable[[Events], None], *, width: int, height: int, sensor: str) -> None:
        self._send, self._size, self._sensor = send, (width, height), sensor
        self._pending: list[EventArrays] = []
        self._end_us = self._start_us = self._sequence = 0

    def add(self, block: EventArrays) -> None:
        """Take events, sorted by time."""
        if not len(block.t):
            return
        tick = -(-block.t // PACKET_US)  # a window is (start, end]
        begins = np.concatenate([[0], np.flatnonzero(np.diff(tick)) + 1, [len(tick)]])
        for begin, end in zip(begins[:-1].tolist(), begins[1:].tolist(), strict=True):
            end_us = max(int(tick[begin]), 1) * PACKET_US
            if end_us != self._end_us:
                self._flush()
                self._end_us = end_us
            self._pending.append(block.rows(slice(begin, end)))

    def end(self) -> None:
        """Send what is left; without any events, one packet that is empty."""
        self._flush(always=self._sequence == 0)

    def _flush(self, *, always: bool = False) -> None:
        if not self._pending and not always:
            return
        self._sequence += 1
        columns = [np.concatenate(part) for part in zip(NO_EVENTS, *self._pending, strict=True)]
        self._send(
            Events(
                stamp_ns=self._end_us * 1000, start_ns=self._start_us * 1000, sequence=self._sequence - 1,
                sensor=self._sensor, width=self._size[0], height=self._size[1],
                t=columns[0], x=columns[1], y=columns[2], polarity=columns[3],
            )
        )  # fmt: skip
        self._pending = []
        self._start_us = self._end_us


def read_header(file: BinaryIO) -> dict[str, str]:
    """Return the lines that begin with %, by their first word in lower case; the file is behind them then."""
    header: dict[str, str] = {}
    while True:
        begin = file.tell()
        line = file.readline(_HEADER_LINE_MAX)
        if not line.startswith(b"% ") or not line.endswith(b"\n"):
            file.seek(begin)
            return header
        key, _, value = line[2:].decode("latin-1").strip().partition(" ")
        if key == "end":
            return header
        header[key.lower()] = value.strip()


def _find_size(blocks: Iterator[EventArrays]) -> tuple[int, int]:
    """Return width and height of the smallest sensor that has all pixels that fire."""
    width = height = 1
    for events in blocks:
        if len(events.t):
            width = max(width, int(events.x.max()) + 1)
            height = max(height, int(events.y.max()) + 1)
    return width, height


def events_of(t: ArrayLike, x: ArrayLike, y: ArrayLike, polarity: ArrayLike) -> EventArrays:
    """Return columns in the types that events have; darker may be -1 as well as 0.

    Raises:
        ValueError: A number is none that its type has: it is negative, too large, or not whole.
    """
    signs = np.asarray(polarity)
    if signs.dtype.kind in "if":
        signs = np.where(signs == -1, 0, signs)
    kinds = (np.int64, np.uint16, np.uint16, np.uint8)
    columns = []
    for name, given, kind in zip(EventArrays._fields, (t, x, y, signs), kinds, strict=True):
        values = np.asarray(given)
        with np.errstate(invalid="ignore"):
            columns.append(values.astype(kind, copy=False))
        if not np.can_cast(values.dtype, kind) and (columns[-1] != values).any():
            raise ValueError(f"an event has {name} = {values[np.argmax(columns[-1] != values)]}")
    return EventArrays(*columns)


def are_seconds(t: NDArray[Any]) -> bool:
    """Whether the first times of a file are seconds, if it does not say: those of microseconds are whole."""
    with np.errstate(invalid="ignore"):  # what is infinite is refused later
        return t.dtype.kind == "f" and bool((t % 1.0).any())


def in_microseconds(t: NDArray[Any], unit_us: float | None) -> NDArray[Any]:
    """Return times in whole microseconds, of a unit; None: they are microseconds already."""
    if unit_us == 1e-3 and t.dtype.kind in "iu":  # of nanoseconds since 1970 float64 has not all
        return t // 1000 + (t % 1000 >= 500)  # no sum that 32 bits might not hold
    return t if unit_us is None else np.rint(t * unit_us)


def read_words(file: BinaryIO, begin: int, size: int, notes: list[str]) -> Iterator[tuple[int, bytes]]:
    """Yield whole words of `size` bytes from `begin` on, and where each part begins; note a cut one."""
    left = 0
    while not left:
        file.seek(begin)
        data = file.read(4 * BLOCK_EVENTS)
        left = len(data) % size
        if left:
            notes.append(f"{file.name} ends within a word: it was cut off")
        if len(data) == left:
            return
        yield begin, data[: len(data) - left]
        begin += len(data)


def choose_topic(path: Path, cameras: list[str], sensor: str) -> str:
    """Return the topic of an event camera by its last name; of an empty name the first."""
    chosen = [topic for topic in cameras if not sensor or topic.endswith(f"/{sensor.lstrip('/')}")]
    if not chosen:
        raise EventFileError(f"{path} has no event camera {sensor!r}, known: {cameras}")
    return chosen[0]


def gather_blocks(parts: Iterable[Any]) -> Iterator[EventArrays]:
    """Yield events, or what has their columns, together until they are a million."""
    pending: list[EventArrays] = []
    for part in parts:
        pending.append(EventArrays(part.t, part.x, part.y, part.polarity))
        if sum(len(each.t) for each in pending) >= BLOCK_EVENTS:
            yield join_events(pending)
            pending = []
    if pending:
        yield join_events(pending)


def split_blocks(events: EventArrays, count: int = BLOCK_EVENTS) -> Iterator[EventArrays]:
    """Yield events in blocks of a limited size."""
    for begin in range(0, len(events.t), count):
        yield events.rows(slice(begin, begin + count))
