"""The reader of recordings: gives back the packets that were written."""

from __future__ import annotations

import contextlib
import heapq
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import EventArrays, GenericPacket, Packet, PacketSchema, packet_class
from neurosim_core.record.chunks import read_rows
from neurosim_core.record.hdf5 import FORMAT, FORMAT_VERSION, import_h5py
from neurosim_core.record.header import Intrinsics, RecordingHeader, SensorDescription
from neurosim_core.record.streams import DSEC_NAMES, HEADER_COLUMNS, LARGE_ROW_BYTES, read_constant
from neurosim_core.registry import load_plugins

log = logging.getLogger(__name__)

_BLOCK_ROWS = 4096


class Recording:
    """Reads a recording. A context manager.

    Attributes:
        header: What goes with the packets.
        clean: Whether the run ended properly. If not, what came after its last flush is missing.
        notes: What a user should know about this file, one sentence each; also logged.
    """

    def __init__(self, path: str | Path) -> None:
        """Open a file.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is not a recording, is damaged, or of another format version.
            ImportError: h5py is not installed.
        """
        h5py = import_h5py()
        self._path = Path(path)
        if not self._path.is_file():
            raise FileNotFoundError(f"no file {self._path}")
        try:
            self._file = h5py.File(self._path, "r")
        except OSError as error:
            raise ValueError(f"{self._path} is not a readable HDF5 file: {error}") from error
        try:
            with damage_of(self._path):
                self.header = _read_header(self._file, self._path)
                self.clean = bool(self._file.attrs["clean"])
                self._streams = {
                    name: _Stream(name, group)
                    for name, group in self._file["sensors"].items()
                    if "packet_count" in group
                }
        except Exception:
            self._file.close()
            raise
        notes = [stream.note for stream in self._streams.values() if stream.note]
        if not self.clean:
            notes.append(f"{self._path} was not closed properly: packets at its end are missing")
        self.notes = tuple(notes)
        for note in notes:
            log.warning(note)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that have packets, in alphabetical order."""
        return tuple(sorted(self._streams))

    def schema(self, sensor: str) -> PacketSchema:
        """Return the schema of the packets of a sensor.

        Raises:
            ValueError: No such sensor.
        """
        return self._stream(sensor).schema

    def packet_count(self, sensor: str) -> int:
        """Return the number of packets of a sensor.

        Raises:
            ValueError: No such sensor.
        """
        return self._stream(sensor).packet_count

    def column(self, sensor: str, field: str) -> NDArray[Any]:
        """Return one field of all packets of a sensor as one array, shape [packets, ...].

        Such as ("odometry", "position"). The fields are those of the packet; for pictures `data`, whole, in
        memory. Arrays of varying length come joined, one packet after the other.

        Raises:
            ValueError: No such sensor or field.
        """
        return self._stream(sensor).column(field)

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
        streams = [self._stream(name).packets(start_s, end_s) for name in (sensors or self.sensors)]
        merged = heapq.merge(*streams, key=lambda item: item[:2])
        while True:
            with damage_of(self._path):
                _, _, packet = next(merged, (None, None, None))
            if packet is None:
                return
            yield packet

    def events(self, sensor: str, start_s: float, end_s: float) -> EventArrays:
        """Return the events of a camera with start_s <= t < end_s.

        Only the milliseconds that are asked for are read.

        Raises:
            ValueError: No such sensor, or not an event camera.
        """
        stream = self._stream(sensor)
        if not stream.schema.has_events:
            raise ValueError(f"sensor {sensor!r} sends {stream.schema.name}, not Events")
        start_us, end_us = (-(-round(s * 1e9) // 1000) for s in (start_s, end_s))  # first whole microsecond
        total = stream.end("event", stream.packet_count)
        events = read_milliseconds(stream.group, start_us, end_us, event_count=total)
        begin, end = np.searchsorted(events.t, [start_us, end_us])
        return events.rows(slice(begin, max(begin, end)))

    def _stream(self, sensor: str) -> _Stream:
        if sensor not in self._streams:
            raise ValueError(f"unknown sensor {sensor!r}, known: {list(self.sensors)}")
        return self._streams[sensor]


class _Stream:
    """The packets of one sensor in the file."""

    def __init__(self, name: str, group: Any) -> None:
        self.name = name
        self.group = group
        self.schema = PacketSchema.from_json(group.attrs["schema"])
        self.packet_class = packet_class(self.schema)
        if issubclass(self.packet_class, GenericPacket):
            load_plugins()  # one of them may define the class
            self.packet_class = packet_class(self.schema)
        self.packet_count = int(group["packet_count"][()])
        self.note = ""
        if issubclass(self.packet_class, GenericPacket):
            self.note = (
                f"sensor {name!r} sends packets of class {self.schema.name}, which is not known here as it "
                "was recorded: its packets are read as generic ones (import the module that defines it "
                "first, or install it as a plug-in)"
            )
        self._constants: dict[str, Any] = {}
        self._datasets: dict[str, Any] = {}
        dsec = DSEC_NAMES if self.schema.has_events else {}
        for field in self.schema.fields:
            if field.constant:
                self._constants[field.name] = read_constant(group, field.name)
            else:
                dataset = group[dsec.get(field.name, field.name)]
                self._datasets[field.name] = dataset.asstr() if field.dtype == "str" else dataset

    def column(self, name: str) -> NDArray[Any]:
        """Return a field of all packets; arrays of varying length joined."""
        if name in HEADER_COLUMNS:
            return np.asarray(self.group[name][: self.packet_count])
        if name not in self._datasets:
            known = [*HEADER_COLUMNS, *self._datasets]
            raise ValueError(f"unknown field {name!r} of sensor {self.name!r}, known: {known}")
        varying = self.schema.field(name).varying
        count = self.end(varying, self.packet_count) if varying else self.packet_count
        return np.asarray(self._datasets[name][:count])

    def end(self, length: str, row: int) -> int:
        """Return where the arrays of the packets before a row end."""
        return int(self.group[f"{length}_end"][row - 1]) if row else 0

    def packets(self, start_s: float | None, end_s: float | None) -> Iterator[tuple[int, int, Packet]]:
        """Yield (stamp, place in the file, packet) of a window of time."""
        stamps = self.group["stamp_ns"][: self.packet_count]
        begin = 0 if start_s is None else int(np.searchsorted(stamps, round(start_s * 1e9)))
        end = self.packet_count if end_s is None else int(np.searchsorted(stamps, round(end_s * 1e9)))
        for low in range(begin, end, _BLOCK_ROWS):
            yield from self._block(low, min(low + _BLOCK_ROWS, end))

    def _block(self, low: int, high: int) -> Iterator[tuple[int, int, Packet]]:
        header = {name: self.group[name][low:high] for name in HEADER_COLUMNS}
        fields = [field for field in self.schema.fields if not field.constant]
        lengths = {field.varying for field in fields if field.varying}
        ends = {name: [self.end(name, low), *self.group[f"{name}_end"][low:high]] for name in lengths}
        small = {}
        for field in fields:
            dataset = self.group.get(field.name)
            row_bytes = 0 if dataset is None else int(np.prod(dataset.shape[1:])) * dataset.dtype.itemsize
            if not field.varying and row_bytes < LARGE_ROW_BYTES:
                small[field.name] = self._datasets[field.name][low:high]
        for row in range(high - low):
            values = dict(self._constants)
            for field in fields:
                if field.varying:
                    part = slice(ends[field.varying][row], ends[field.varying][row + 1])
                    values[field.name] = self._datasets[field.name][part]
                elif field.name not in small:
                    values[field.name] = self._datasets[field.name][low + row]
                else:
                    value = small[field.name][row]
                    scalar = isinstance(value, np.generic) and not field.shape
                    values[field.name] = value.item() if scalar else np.copy(value) if field.shape else value
            stamp_ns, sequence, order = (int(header[name][row]) for name in HEADER_COLUMNS)
            packet = self.packet_class(stamp_ns=stamp_ns, sequence=sequence, sensor=self.name, **values)
            yield stamp_ns, order, packet


def read_milliseconds(group: Any, start_us: int, end_us: int, *, event_count: int) -> EventArrays:
    """Return the events of the whole milliseconds from that of `start_us` to that of `end_us`.

    `group`: of a camera in the file. `event_count`: how many of its events are complete.
    """
    index = group["ms_to_idx"]
    milliseconds = (max(start_us // 1000, 0), max(end_us // 1000 + 1, 0))
    low, high = (min(int(index[ms]), event_count) if ms < len(index) else event_count for ms in milliseconds)
    return EventArrays(*(read_rows(group[DSEC_NAMES[name]], low, high) for name in EventArrays._fields))


@contextlib.contextmanager
def damage_of(path: Path, kind: type[ValueError] = ValueError) -> Iterator[None]:
    """Say of the errors of HDF5 that they are damage of a file, by an error of a kind."""
    try:
        yield
    except kind:
        raise
    except (IndexError, KeyError, OSError, OverflowError, RuntimeError, TypeError, ValueError) as error:
        plugin = "; DSEC compresses with Blosc: pip install hdf5plugin" if "filter" in str(error) else ""
        raise kind(f"{path} is damaged: {error}{plugin}") from error


def _read_header(file: Any, path: Path) -> RecordingHeader:
    if file.attrs.get("format") != FORMAT:
        raise ValueError(
            f"{path} is an HDF5 file but not a recording: its attribute 'format' is not {FORMAT!r}"
        )
    version = int(file.attrs["format_version"])
    if version != FORMAT_VERSION:
        age = "an older" if version < FORMAT_VERSION else "a newer"
        raise ValueError(
            f"{path} was written by {age} version of Neurosim ({file.attrs['version']}, format version "
            f"{version}); this version reads format version {FORMAT_VERSION}: read it with that version, or "
            "with plain h5py, or record again"
        )
    described = [group for group in file["sensors"].values() if "index" in group.attrs]
    return RecordingHeader(
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
        names = ("width", "height", "fx", "fy", "cx", "cy")
        lens = *group.attrs["resolution"].tolist(), *group.attrs["intrinsics"].tolist()
        intrinsics = Intrinsics(
            **dict(zip(names, lens, strict=True)),
            distortion_model=str(group.attrs.get("distortion_model", "")),
            distortion=tuple(float(v) for v in group.attrs.get("distortion", ())),
        )
    return SensorDescription(
        name=group.name.rsplit("/", 1)[1],
        kind=str(group.attrs["kind"]),
        rate_hz=float(group.attrs["rate_hz"]),
        position=np.asarray(group.attrs["p_BS"]),
        orientation=np.asarray(group.attrs["q_BS_xyzw"]),
        intrinsics=intrinsics,
        settings=str(group.attrs["settings"]),
        has_events="events" in group,
    )
