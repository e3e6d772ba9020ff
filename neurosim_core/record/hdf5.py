"""Flights as HDF5 files: a writer with bounded memory, and a reader that gives back the same packets.

Layout (format version 1). Every array can be read with plain h5py or any other HDF5 program: only gzip
and shuffle are used, which are part of HDF5 itself.

    /                        attributes: format, format_version, version, seed, scene, clean
    /config_yaml             the resolved configuration
    /path/{stamp_ns,position}
    /sensors/<name>          attributes: packet (type), kind, rate_hz, p_BS, q_BS_xyzw,
                             intrinsics (fx fy cx cy), resolution (width height), settings (JSON)
        packet_count         how many packets are complete
        stamp_ns, sequence   one row per packet
        order                counts the packets of the whole file, as written
      event cameras
        events/{x,y,t,p}     one row per event: column, row, microseconds, 1 brighter | 0 darker
        ms_to_idx            t[ms_to_idx[ms]] >= 1000 ms and t[ms_to_idx[ms] - 1] < 1000 ms
        t_offset             0: t counts from the start of the episode, as all stamps do
        event_end            one row per packet: index of its last event + 1
        start_ns, dropped_count    one row per packet: start of its window, events that were lost
      cameras
        data                 one row per picture, one picture per chunk; attribute encoding
      all others             one array per field of the packet, one row per packet; float64, and int64 for
                             the whole numbers of what a simulated link did (sensor "<link>_link")
    /events /ms_to_idx /t_offset    the same arrays (hard links) of the first event camera, so that readers
                                    of DSEC files work; they take the group of any other camera just as well

A killed run leaves a readable file. Packets are held in memory and written together at every flush; what
was flushed is never touched again: space in the file is not reused, HDF5's bookkeeping is replaced in one go
after the data, and a row counts only once `packet_count`, which is written last, says so. What is lost is
what came after the last flush.

Reference: DSEC, Gehrig et al. (2021), https://dsec.ifi.uzh.ch/data-format, for events, ms_to_idx, t_offset.
"""

from __future__ import annotations

import contextlib
import dataclasses
import heapq
import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from neurosim_core.install import install_hint
from neurosim_core.packets import (
    Collision,
    Delivery,
    EventArrays,
    Events,
    Image,
    ImuSample,
    Odometry,
    Packet,
)
from neurosim_core.record.disk import Disk
from neurosim_core.record.header import FlightHeader, Intrinsics, SensorDescription

log = logging.getLogger(__name__)

FORMAT = "neurosim.flight"
FORMAT_VERSION = 1

_PACKET_TYPES: dict[str, type[Packet]] = {
    t.__name__: t for t in (Events, Image, ImuSample, Odometry, Collision, Delivery)
}
_HEADER_FIELDS = tuple(f.name for f in dataclasses.fields(Packet))
_WHOLE_FIELDS = ("delivered_ns", "size_bytes")
_EVENT_DTYPES = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8}
_EVENT_CHUNK = 65536  # 0.5 MB of t: fits HDF5's chunk cache, so appending never reads back
_ROW_CHUNK = 1024
_READ_ROWS = 4096


class FlightWriter:
    """Writes the packets of a flight to a file while it happens.

    A context manager. Packets of one sensor must come in the order of their stamps. Arrays are copied, so a
    caller may reuse its buffers.

    Compression is gzip level 1 with shuffle: 80 MB/s for RGB (62 % left), 280 MB/s for smooth depth (10 %
    left), 12 M events/s (3.1 of 13 bytes left). Blosc with zstd is 3-5 times faster at the same size, but
    nobody could read the file without its plug-in; LZF is twice as fast and leaves a quarter more, but only
    h5py reads it.
    """

    def __init__(
        self,
        path: str | Path,
        header: FlightHeader,
        *,
        flush_interval_s: float = 1.0,
        buffer_bytes: int = 8_000_000,
    ) -> None:
        """Create the file, replacing one that exists.

        Args:
            path: The file; its folder must exist.
            header: What goes with the packets.
            flush_interval_s: Longest wall-clock time between two flushes [s]; checked when a packet comes.
            buffer_bytes: Flush when the packets in memory exceed this size.

        Raises:
            OSError: The file cannot be created.
            ImportError: h5py is not installed.
        """
        h5py = _import_h5py()
        self._path = Path(path)
        self._flush_interval_s = flush_interval_s
        self._buffer_bytes = buffer_bytes
        self._streams: dict[str, _Stream] = {}
        self._order = 0
        self._pending_bytes = 0
        self._flushed_s = time.monotonic()
        try:
            self._disk = Disk(self._path)
        except OSError as error:
            raise OSError(f"cannot write {self._path}: {error.strerror}") from error
        # The oldest format: many programs read it, and no mark "open for writing" bars a killed file. Freed
        # space is never reused: what is on disk stays valid until the next flush is complete.
        self._file = h5py.File(self._disk, "w", libver=("earliest", "v110"), fs_strategy="none")
        self._described = _write_header(self._file, header)
        self._file.flush()
        self._disk.seal()
        cameras = [s.name for s in header.sensors if s.kind == "event_camera"]
        self._root_camera = cameras[0] if cameras else None

    @property
    def pending_bytes(self) -> int:
        """Size of the packets that are in memory and not yet in the file [bytes]."""
        return self._pending_bytes

    def write(self, packet: Packet) -> None:
        """Add one packet.

        Raises:
            OSError: The disk is full or gone.
            ValueError: The packet does not continue its stream: stamp earlier than the one before, other
                resolution, other type; or it has no sensor name.
        """
        stream = self._streams.get(packet.sensor) or self._open_stream(packet)
        self._pending_bytes += stream.append(packet, self._order)
        self._order += 1
        due = time.monotonic() - self._flushed_s >= self._flush_interval_s
        if due or self._pending_bytes >= self._buffer_bytes:
            self.flush()

    def flush(self) -> None:
        """Bring everything that was written so far into the file.

        Raises:
            OSError: The disk is full or gone.
        """
        for stream in self._streams.values():
            stream.write_rows()
        self._file.flush()
        self._disk.seal()
        for stream in self._streams.values():
            stream.commit()
        self._file.flush()
        self._disk.seal()
        self._pending_bytes = 0
        self._flushed_s = time.monotonic()

    def close(self, *, complete: bool = True) -> None:
        """Write what is left, and mark the file as complete unless it is not. Closing twice is allowed.

        Args:
            complete: All that was to be recorded was written.

        Raises:
            OSError: The disk is full or gone.
        """
        if not self._file:
            return
        try:
            if not self._disk.failed:  # a failure is reported once
                for stream in self._streams.values():
                    stream.finish()
                self.flush()
                self._file.attrs["clean"] = complete
                self._file.flush()
                self._disk.seal()
        finally:
            self._file.close()
            self._disk.close()

    def __enter__(self) -> FlightWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:  # keep what is there, but do not hide the error
            with contextlib.suppress(OSError):
                self.close()

    def _open_stream(self, packet: Packet) -> _Stream:
        name = packet.sensor
        if not name or "/" in name:
            raise ValueError(f"a packet needs a sensor name without '/', got {name!r}")
        if type(packet).__name__ not in _PACKET_TYPES:
            raise ValueError(
                f"cannot record a packet of type {type(packet).__name__!r}, known: {sorted(_PACKET_TYPES)}"
            )
        group = self._described.get(name) or self._file["sensors"].create_group(name)
        stream = _Stream(group, packet)
        self._streams[name] = stream
        if isinstance(packet, Events) and self._root_camera in (None, name):
            self._root_camera = name
            for key in ("events", "ms_to_idx", "t_offset"):
                self._file[key] = group[key]
        return stream


class _Column:
    """One array of the file that grows by rows, with the rows that are not yet in it."""

    def __init__(
        self, group: Any, name: str, shape: tuple[int, ...], dtype: DTypeLike, *, chunk: int, compressed: bool
    ) -> None:
        # A chunk that is stored as it is, is extended in place; a compressed one is written anew, elsewhere.
        filters = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if compressed else {}
        self._dataset = group.create_dataset(
            name, shape=(0, *shape), maxshape=(None, *shape), dtype=dtype, chunks=(chunk, *shape), **filters
        )
        self._shape = shape
        self._dtype = self._dataset.dtype
        self._rows: list[NDArray[Any]] = []

    def append(self, rows: Any) -> int:
        block = np.asarray(rows).astype(self._dtype, casting="same_kind").reshape(-1, *self._shape)  # a copy
        self._rows.append(block)
        return block.nbytes

    def write_rows(self) -> None:
        if not self._rows:
            return
        rows = np.concatenate(self._rows) if len(self._rows) > 1 else self._rows[0]
        self._rows = []
        begin = self._dataset.shape[0]
        self._dataset.resize(begin + rows.shape[0], axis=0)
        if rows.shape[0]:
            self._dataset[begin:] = rows


class _Stream:
    """The packets of one sensor in the file."""

    def __init__(self, group: Any, first: Packet) -> None:
        self._group = group
        self._type = type(first)
        self._columns: dict[str, _Column] = {}
        self._last_ns: int | None = None
        self._written = 0
        self._event_count = 0
        self._ms_count = 0
        group.attrs["packet"] = self._type.__name__
        self._packet_count = group.create_dataset("packet_count", data=np.int64(0))
        for name in ("stamp_ns", "sequence", "order"):
            self._add(name, (), np.int64)
        self._append_body: Callable[[Any], int]
        self._constant: dict[str, object]
        if isinstance(first, Events):
            self._append_body = self._append_events
            self._constant = {"width": first.width, "height": first.height}
            group.create_dataset("t_offset", data=np.int64(0))
            events = group.create_group("events")
            for name, dtype in _EVENT_DTYPES.items():
                self._columns[name] = _Column(events, name, (), dtype, chunk=_EVENT_CHUNK, compressed=True)
            self._add("ms_to_idx", (), np.uint64)
            for name in ("event_end", "start_ns", "dropped_count"):
                self._add(name, (), np.int64)
        elif isinstance(first, Image):
            self._append_body = self._append_image
            self._constant = {
                "encoding": first.encoding,
                "shape": first.data.shape,
                "dtype": first.data.dtype.str,
            }
            self._columns["data"] = _Column(
                group, "data", first.data.shape, first.data.dtype, chunk=1, compressed=True
            )
        else:
            self._append_body = self._append_fields
            shapes = {name: np.shape(getattr(first, name)) for name in _body_fields(self._type)}
            self._constant = dict(shapes)
            for name, shape in shapes.items():
                self._add(name, shape, np.int64 if name in _WHOLE_FIELDS else np.float64)
        for name in ("width", "height", "encoding"):
            if name in self._constant:
                group.attrs[name] = self._constant[name]

    def _add(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self._columns[name] = _Column(self._group, name, shape, dtype, chunk=_ROW_CHUNK, compressed=False)

    def append(self, packet: Packet, order: int) -> int:
        """Keep a packet for the next flush; return its size [bytes]."""
        if type(packet) is not self._type:
            raise ValueError(
                f"sensor {packet.sensor!r} sends {self._type.__name__}, got a {type(packet).__name__}"
            )
        if self._last_ns is not None and packet.stamp_ns < self._last_ns:
            raise ValueError(
                f"sensor {packet.sensor!r}: stamp {packet.stamp_ns} ns comes after {self._last_ns} ns"
            )
        size = self._append_body(packet)
        for name, value in (("stamp_ns", packet.stamp_ns), ("sequence", packet.sequence), ("order", order)):
            size += self._columns[name].append(value)
        self._last_ns = packet.stamp_ns
        self._written += 1
        return size

    def write_rows(self) -> None:
        for column in self._columns.values():
            column.write_rows()

    def commit(self) -> None:
        """Declare what is in the file as complete."""
        self._packet_count[()] = self._written

    def finish(self) -> None:
        """End the millisecond index one entry after the last event: windows up to the end can be read."""
        if self._type is Events:
            self._columns["ms_to_idx"].append(np.array([self._event_count], dtype=np.uint64))

    def _require(self, packet: Packet, **found: object) -> None:
        if found != self._constant:
            raise ValueError(f"sensor {packet.sensor!r} was {self._constant} before, got {found}")

    def _append_events(self, packet: Events) -> int:
        self._require(packet, width=packet.width, height=packet.height)
        t, x, y, polarity = packet.numpy()
        size = 0
        for name, values in (("t", t), ("x", x), ("y", y), ("p", polarity)):
            size += self._columns[name].append(values)
        # Events of later packets are not older than this packet's stamp: the index is final up to there.
        milliseconds = np.arange(self._ms_count, packet.stamp_ns // 1_000_000 + 1)
        first = np.searchsorted(t, milliseconds * 1000) + self._event_count
        size += self._columns["ms_to_idx"].append(first.astype(np.uint64))
        self._ms_count += len(milliseconds)
        self._event_count += len(t)
        for name, value in (
            ("event_end", self._event_count),
            ("start_ns", packet.start_ns),
            ("dropped_count", packet.dropped_count),
        ):
            size += self._columns[name].append(value)
        return size

    def _append_image(self, packet: Image) -> int:
        self._require(packet, encoding=packet.encoding, shape=packet.data.shape, dtype=packet.data.dtype.str)
        return self._columns["data"].append(packet.data[None])

    def _append_fields(self, packet: Packet) -> int:
        values = {name: np.asarray(getattr(packet, name)) for name in self._constant}
        self._require(packet, **{name: value.shape for name, value in values.items()})
        return sum(self._columns[name].append(value[None]) for name, value in values.items())


class Flight:
    """Reads a flight from a file. A context manager.

    Attributes:
        header: What goes with the packets.
        clean: Whether the run ended properly. If not, what came after its last flush is missing.
        notes: What a user should know about this file, one sentence each; also logged.
    """

    def __init__(self, path: str | Path) -> None:
        """Open a file.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is not a flight, or of a later format version.
            ImportError: h5py is not installed.
        """
        h5py = _import_h5py()
        self._path = Path(path)
        if not self._path.is_file():
            raise FileNotFoundError(f"no file {self._path}")
        try:
            self._file = h5py.File(self._path, "r")
        except OSError as error:
            raise ValueError(f"{self._path} is not a readable HDF5 file: {error}") from error
        try:
            self.header = _read_header(self._file, self._path)
        except Exception:
            self._file.close()
            raise
        self.clean = bool(self._file.attrs["clean"])
        self._sensors: dict[str, Any] = {
            name: group for name, group in self._file["sensors"].items() if "packet_count" in group
        }
        self.notes: tuple[str, ...] = ()
        if not self.clean:
            self.notes = (f"{self._path} was not closed properly: packets at its end are missing",)
            log.warning(self.notes[0])

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Flight:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that have packets, in alphabetical order."""
        return tuple(sorted(self._sensors))

    def packet_count(self, sensor: str) -> int:
        """Return the number of packets of a sensor.

        Raises:
            ValueError: No such sensor.
        """
        return int(self._group(sensor)["packet_count"][()])

    def column(self, sensor: str, field: str) -> NDArray[Any]:
        """Return one field of all packets of a sensor as one array, shape [packets, ...].

        Such as ("odometry", "position"). The fields are those of the packet; for pictures `data`, whole, in
        memory. For events use `events`.

        Raises:
            ValueError: No such sensor or field.
        """
        group = self._group(sensor)
        known = [key for key, item in group.items() if key not in _NOT_COLUMNS and item.ndim > 0]
        if field not in known:
            raise ValueError(f"unknown field {field!r} of sensor {sensor!r}, known: {known}")
        return np.asarray(group[field][: self.packet_count(sensor)])

    def packets(
        self, *sensors: str, start_s: float | None = None, end_s: float | None = None
    ) -> Iterator[Packet]:
        """Yield packets in the order of their stamps; those of equal stamp as they were written.

        Args:
            sensors: Names; all if none is given.
            start_s: Leave out packets with an earlier stamp [s].
            end_s: Leave out packets with this stamp or a later one [s].

        Raises:
            ValueError: No such sensor.
        """
        groups = {name: self._group(name) for name in (sensors or self.sensors)}
        streams = [self._stream(name, group, start_s, end_s) for name, group in groups.items()]
        for _, _, packet in heapq.merge(*streams, key=lambda item: item[:2]):
            yield packet

    def events(self, sensor: str, start_s: float, end_s: float) -> EventArrays:
        """Return the events of a camera with start_s <= t < end_s.

        Only the milliseconds that are asked for are read.

        Raises:
            ValueError: No such sensor, or not an event camera.
        """
        group = self._group(sensor)
        if group.attrs["packet"] != "Events":
            raise ValueError(f"sensor {sensor!r} sends {group.attrs['packet']}, not Events")
        count = self.packet_count(sensor)
        total = int(group["event_end"][count - 1]) if count else 0
        start_us, end_us = (-(-round(s * 1e9) // 1000) for s in (start_s, end_s))  # first whole microsecond
        index = group["ms_to_idx"]

        def first_at(millisecond: int) -> int:
            return min(int(index[millisecond]), total) if millisecond < len(index) else total

        low = first_at(max(start_us // 1000, 0))
        high = first_at(max(end_us // 1000 + 1, 0))
        events = {name: group["events"][name][low:high] for name in _EVENT_DTYPES}
        begin, end = np.searchsorted(events["t"], [start_us, end_us])
        end = max(begin, end)
        return EventArrays(*(events[name][begin:end] for name in ("t", "x", "y", "p")))

    def _group(self, sensor: str) -> Any:
        if sensor not in self._sensors:
            raise ValueError(f"unknown sensor {sensor!r}, known: {list(self.sensors)}")
        return self._sensors[sensor]

    def _stream(
        self, name: str, group: Any, start_s: float | None, end_s: float | None
    ) -> Iterator[tuple[int, int, Packet]]:
        count = int(group["packet_count"][()])
        stamps = group["stamp_ns"][:count]
        begin = 0 if start_s is None else int(np.searchsorted(stamps, round(start_s * 1e9)))
        end = count if end_s is None else int(np.searchsorted(stamps, round(end_s * 1e9)))
        kind = str(group.attrs["packet"])
        for low in range(begin, end, _READ_ROWS):
            rows = slice(low, min(low + _READ_ROWS, end))
            block = {
                key: item[rows]
                for key, item in group.items()
                if key not in _NOT_COLUMNS and key != "data" and item.ndim > 0
            }
            previous = int(group["event_end"][low - 1]) if kind == "Events" and low else 0
            for row in range(rows.stop - low):
                header: dict[str, Any] = {
                    "stamp_ns": int(block["stamp_ns"][row]),
                    "sequence": int(block["sequence"][row]),
                    "sensor": name,
                }
                packet: Packet
                if kind == "Events":
                    event_end = int(block["event_end"][row])
                    span = slice(previous, event_end)
                    previous = event_end
                    packet = Events(
                        **header,
                        t=group["events"]["t"][span],
                        x=group["events"]["x"][span],
                        y=group["events"]["y"][span],
                        polarity=group["events"]["p"][span],
                        width=int(group.attrs["width"]),
                        height=int(group.attrs["height"]),
                        start_ns=int(block["start_ns"][row]),
                        dropped_count=int(block["dropped_count"][row]),
                    )
                elif kind == "Image":
                    packet = Image(**header, data=group["data"][low + row], encoding=group.attrs["encoding"])
                else:
                    packet_type = _PACKET_TYPES[kind]
                    values = {key: block[key][row] for key in _body_fields(packet_type)}
                    header |= {k: v.item() if v.ndim == 0 else v.copy() for k, v in values.items()}
                    packet = packet_type(**header)
                yield packet.stamp_ns, int(block["order"][row]), packet


_NOT_COLUMNS = ("events", "ms_to_idx")


def _body_fields(packet_type: type[Packet]) -> list[str]:
    return [f.name for f in dataclasses.fields(packet_type) if f.name not in _HEADER_FIELDS]


def _write_header(file: Any, header: FlightHeader) -> dict[str, Any]:
    """Write what is known before the flight; return the group of each described sensor."""
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = FORMAT_VERSION
    file.attrs["clean"] = False
    file.attrs["version"] = header.version
    file.attrs["seed"] = header.seed
    file.attrs["scene"] = header.scene
    file["config_yaml"] = header.config_yaml
    file["path/stamp_ns"] = header.path_stamp_ns
    file["path/position"] = header.path_position
    groups: dict[str, Any] = {}
    file.create_group("sensors")
    for index, sensor in enumerate(header.sensors):
        group = file.create_group(f"sensors/{sensor.name}")
        groups[sensor.name] = group
        group.attrs["index"] = index
        group.attrs["kind"] = sensor.kind
        group.attrs["rate_hz"] = sensor.rate_hz
        group.attrs["p_BS"] = sensor.position
        group.attrs["q_BS_xyzw"] = sensor.orientation
        group.attrs["settings"] = sensor.settings
        if sensor.intrinsics is not None:
            lens = sensor.intrinsics
            group.attrs["intrinsics"] = [lens.fx, lens.fy, lens.cx, lens.cy]
            group.attrs["resolution"] = [lens.width, lens.height]
    return groups


def _read_header(file: Any, path: Path) -> FlightHeader:
    if file.attrs.get("format") != FORMAT:
        raise ValueError(f"{path} is an HDF5 file but not a flight: its attribute 'format' is not {FORMAT!r}")
    version = int(file.attrs["format_version"])
    if version > FORMAT_VERSION:
        raise ValueError(
            f"{path} has format version {version}; this version of Neurosim reads up to {FORMAT_VERSION}"
        )
    described = [group for group in file["sensors"].values() if "index" in group.attrs]
    return FlightHeader(
        config_yaml=file["config_yaml"].asstr()[()],
        seed=int(file.attrs["seed"]),
        version=str(file.attrs["version"]),
        scene=str(file.attrs["scene"]),
        sensors=tuple(
            _read_sensor(group) for group in sorted(described, key=lambda g: int(g.attrs["index"]))
        ),
        path_stamp_ns=file["path/stamp_ns"][:],
        path_position=file["path/position"][:],
    )


def _read_sensor(group: Any) -> SensorDescription:
    intrinsics = None
    if "intrinsics" in group.attrs:
        fx, fy, cx, cy = (float(v) for v in group.attrs["intrinsics"])
        width, height = (int(v) for v in group.attrs["resolution"])
        intrinsics = Intrinsics(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
    return SensorDescription(
        name=group.name.rsplit("/", 1)[1],
        kind=str(group.attrs["kind"]),
        rate_hz=float(group.attrs["rate_hz"]),
        position=np.asarray(group.attrs["p_BS"]),
        orientation=np.asarray(group.attrs["q_BS_xyzw"]),
        intrinsics=intrinsics,
        settings=str(group.attrs["settings"]),
    )


def _import_h5py() -> ModuleType:
    try:
        import h5py
    except ImportError as error:
        raise ImportError(f"recordings need h5py: {install_hint('record')}") from error
    return h5py  # type: ignore[no-any-return]
