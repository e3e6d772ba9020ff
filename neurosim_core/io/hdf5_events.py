"""Events in HDF5 files: recordings of Neurosim, files of DSEC, and any with the same four arrays.

The group `events`, or `sensors/NAME/events` of a recording, holds t [us], x, y and p; `t_offset` beside it is
added to t. Files of other names are read, too: ts, xs, ys and ps; records instead of columns; those of M3ED
(`prophesee/left`) and Prophesee (`CD/events`). Times that are not whole are seconds.

Reference: Gehrig et al. (2021), DSEC, https://dsec.ifi.uzh.ch/data-format.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from neurosim_core import __version__
from neurosim_core.io.event_file import (
    BLOCK_EVENTS,
    PACKET_US,
    EventFileError,
    EventSource,
    NoEventsError,
    PacketCutter,
    are_seconds,
    events_of,
    in_microseconds,
)
from neurosim_core.packets import EventArrays, Packet
from neurosim_core.record import Recording, RecordingHeader, RecordingWriter, recording
from neurosim_core.record.chunks import read_rows
from neurosim_core.record.hdf5 import FORMAT, import_h5py
from neurosim_core.record.header import SensorDescription

_NAMES = (("t", "x", "y", "p"), ("ts", "xs", "ys", "ps"))
_PLACES = ("events", "prophesee/left", "CD/events")
_SPAN_MAX_US = 30 * 24 * 3_600_000_000


def damage_of(path: Path) -> contextlib.AbstractContextManager[None]:
    """Turn what h5py raises on a damaged file into an EventFileError."""
    return recording.damage_of(path, EventFileError)


def open_hdf5(path: Path) -> Any:
    """Open an HDF5 file for reading."""
    h5py = import_h5py()
    with contextlib.suppress(ImportError):  # filters of files of DSEC, for whoever has them
        import_module("hdf5plugin")
    with open(path, "rb"):
        pass
    try:
        return h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise EventFileError(f"{path} is not a readable HDF5 file: {error}") from None


class Hdf5Source(EventSource):
    """Reads the events of a recording, or of a file of DSEC."""

    def __init__(self, path: Path, *, sensor: str = "", unit_us: float | None = None) -> None:
        super().__init__(path)
        self._sensor, self._unit_us = sensor, unit_us
        self._file = open_hdf5(path)

    def begin(self) -> None:
        """Find the events."""
        with damage_of(self._path):
            is_own = self._file.attrs.get("format") == FORMAT
            self._group = self._group_of(self._sensor) if is_own else self._file
            self._find_events()
            if is_own and self._unit_us is not None:
                raise EventFileError(f"{self._path}: times of a recording of Neurosim are microseconds")
            self.knows_unit = is_own or self._unit_us is not None
            attributes = self._group.attrs
            is_told = "width" in attributes and "height" in attributes
            self.size = (int(attributes["width"]), int(attributes["height"])) if is_told else None

    def packets(self) -> Iterator[Packet]:
        """Yield what a recording has besides events, in the order of time; of files of DSEC nothing."""
        if self._file.attrs.get("format") != FORMAT:
            return
        with Recording(self._path) as recording:
            others = [name for name in recording.sensors if not recording.schema(name).has_events]
            if others:
                yield from recording.packets(*others)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _group_of(self, sensor: str) -> Any:
        """Return the group of an event camera in a recording."""
        sensors = self._file["sensors"]
        cameras = [name for name, group in sensors.items() if "events" in group]
        if sensor not in ("", *cameras) or not cameras:
            kind = EventFileError if cameras else NoEventsError
            raise kind(f"{self._path} has no event camera {sensor!r}, known: {cameras}")
        if not bool(self._file.attrs["clean"]):
            self.notes.append(f"{self._path} was not closed properly: events at its end are missing")
        first = min(cameras, key=lambda name: int(sensors[name].attrs.get("index", 1 << 30)))
        return sensors[sensor or first]

    def _find_events(self) -> None:
        known = (self._group[place] for place in _PLACES if place in self._group)
        fits = ((found, names) for found in known for names in _NAMES if {*names} <= _parts_of(found))
        self._events: Any
        self._names: tuple[str, ...]
        self._events, self._names = next(fits, (None, ()))
        if self._events is None:
            raise NoEventsError(
                f"{self._path} has no events/t, x, y and p; known HDF5 files: "
                "recordings of Neurosim, DSEC, MVSEC, M3ED, Prophesee"
            )
        is_table = hasattr(self._events, "dtype")
        columns = [self._events] if is_table else [self._events[name] for name in self._names]
        if any(getattr(column, "ndim", 0) != 1 for column in columns):
            raise EventFileError(f"{self._path}: events/t, x, y and p must be arrays of one axis")
        counts = {len(column) for column in columns}
        self._count = min(counts)
        if "packet_count" in self._group:
            packets = int(self._group["packet_count"][()])
            self._count = int(self._group["event_end"][packets - 1]) if packets else 0
        elif len(counts) > 1:
            raise EventFileError(f"{self._path}: events/t, x, y and p have different lengths")
        self._offset_us = int(np.asarray(self._group.get("t_offset", 0)).item())

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        unit_us = self._unit_us
        for begin in range(0, self._count, BLOCK_EVENTS):
            end = min(begin + BLOCK_EVENTS, self._count)
            with damage_of(self._path):
                if hasattr(self._events, "dtype"):
                    rows = self._events[begin:end]
                    t, x, y, p = (rows[name] for name in self._names)
                else:
                    t, x, y, p = (read_rows(self._events[name], begin, end) for name in self._names)
                if len(t) != end - begin:
                    raise EventFileError(f"{self._path}: fewer events than its index says")
                if begin == 0 and unit_us is None and are_seconds(t):
                    unit_us = 1e6
                offset = np.int64(self._offset_us)
                t = in_microseconds(t, unit_us) + in_microseconds(offset, self._unit_us)
                block = events_of(t, x, y, p)
            yield block


class RecordingSink:
    """Writes events as a recording, in packets of 10 ms at least; files of DSEC are laid out like it."""

    def __init__(self, path: Path, *, width: int, height: int, sensor: str = "events") -> None:
        self._path = path
        described = SensorDescription(name=sensor, kind="event_camera", rate_hz=1e6 / PACKET_US)
        header = RecordingHeader(
            config_yaml="conversion: {}\n", seed=0, version=__version__, sensors=(described,)
        )
        self._writer = RecordingWriter(path, header, flush_interval_s=float("inf"))
        self._packets = PacketCutter(self._writer.write, width=width, height=height, sensor=sensor)

    def write(self, events: EventArrays) -> None:
        """See `EventSink.write`."""
        if int(events.t[0]) < 0 or int(events.t[-1]) > _SPAN_MAX_US:
            raise EventFileError(
                f"{self._path}: times of recordings are from 0 to 30 days, got {events.t[0]} to "
                f"{events.t[-1]} us: --from-zero counts them from the first event"
            )
        self._packets.add(events)

    def write_packet(self, packet: Packet) -> None:
        """Append a packet of another sensor."""
        self._writer.write(packet)

    def close(self) -> None:
        """Complete the file."""
        self._packets.end()
        self._writer.close()


def _parts_of(found: Any) -> set[str]:
    """Return the names of the columns of a group, or of a dataset of records."""
    return {*(found if hasattr(found, "keys") else found.dtype.names or ())}
